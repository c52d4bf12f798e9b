"""Rolling shutter: points moved to where they would have been seen at the stamp of their frame.

A camera reads its rows one after the other, and its colour image is rarely of the same moment as its depth image. With
the camera's velocity from the frames around, each point is moved to where it was at the frame's own stamp.
"""

from __future__ import annotations

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.registration.pixels import project
from hodge_pipeline.types import Bools, Camera, Floats, Ints

LONGEST_SPAN_S = 0.5
"""Longest time between the two frames of a velocity: a hand-held camera turns back within half a second."""


def velocities(world_from_cam: Floats, times_s: Floats, sequence: Ints, found: Bools) -> Floats:
    """Twists (N, 6) per second in each camera's axes, by differences between its neighbours in the `sequence (N,)`.

    A neighbour without a pose of its own (`found (N,)`) is replaced by the next but one, or by the frame itself; zero
    where that leaves no two frames within `LONGEST_SPAN_S`.
    """
    rows = np.arange(len(times_s))

    def beside(sign: int) -> Ints:
        out = rows
        for other in (rows + 2 * sign, rows + sign):
            at = np.clip(other, 0, len(rows) - 1)
            out = np.where((other == at) & found & found[at] & (sequence == sequence[at]), at, out)
        return out

    before, after = beside(-1), beside(1)
    span = times_s[after] - times_s[before]
    known = (span > 0) & (span <= LONGEST_SPAN_S)
    twists = se3.log(se3.inverse(world_from_cam[before]) @ world_from_cam[after])
    return np.asarray(np.where(known[:, None], twists / np.where(known, span, 1.0)[:, None], 0.0))


def at_frame_stamp(points_in_cam: Floats, camera: Camera, colour_delay_s: float, twist: Floats) -> Floats:
    """Points (n, 3) in the camera's axes at the frame's stamp, from points (n, 3) back-projected from pixels of the
    colour image and depths of the depth image.

    `twist (6,)` is the camera's velocity in its own axes. The stamp is that of the depth image's middle row; the colour
    image's is `colour_delay_s` later. Both have the same rolling shutter.
    """
    if not (camera.readout_s or colour_delay_s) or not twist.any():
        return points_in_cam
    row = project(points_in_cam, camera)[:, 1]
    row_delay_s = camera.readout_s * (row / camera.height - 0.5)
    velocity = -(np.cross(twist[:3], points_in_cam) + twist[3:])
    z = points_in_cam[:, 2]
    at_colour = points_in_cam * (1 + velocity[:, 2] * colour_delay_s / z)[:, None]
    moved = at_colour - velocity * (colour_delay_s + row_delay_s)[:, None]
    return np.asarray(np.where(np.isfinite(moved), moved, points_in_cam))
