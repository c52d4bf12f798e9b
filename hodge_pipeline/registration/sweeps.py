"""Deskewing of the sweeps of a spinning scanner, with constant velocity within one revolution."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.scene import UNIX_STAMP_S
from hodge_pipeline.types import Floats, Frame, PointCloud

STEPS_A_SWEEP = 64
"""Motions that a revolution is cut into: 1.6 cm each at 10 m/s and 10 revolutions a second."""


def deskewed(cloud: PointCloud, velocity: Floats, after_s: float = 0.0) -> PointCloud:
    """The points as seen from the scanner's pose `after_s` seconds after the first point; unchanged without times.

    `velocity (6,)` is the scanner's twist per second in its own axes.
    """
    if cloud.times_s is None or not len(cloud):
        return cloud
    last_s = max(float(cloud.times_s.max()), 1e-9)
    step = np.minimum(cloud.times_s / last_s * STEPS_A_SWEEP, STEPS_A_SWEEP - 1).astype(np.int64)
    middle_s = (np.arange(STEPS_A_SWEEP) + 0.5) / STEPS_A_SWEEP * last_s
    motions = se3.exp((middle_s - after_s)[:, None] * velocity).astype(np.float32)
    x, y, z = cloud.points_in_cam.T
    points = np.empty((len(cloud), 3), np.float32)
    for axis in range(3):  # by columns: a matrix for each point takes five times as long
        a, b, c, d = (np.ascontiguousarray(entry)[step] for entry in motions[:, axis].T)
        points[:, axis] = a * x + b * y + c * z + d
    points[(x == 0) & (y == 0) & (z == 0)] = 0.0  # no returns stay what they are
    return replace(cloud, points_in_cam=points, normals_in_cam=None, times_s=None)


def turned(cloud: PointCloud) -> PointCloud:
    """The cloud with the times of its points running the other way."""
    if cloud.times_s is None or not len(cloud):
        return cloud
    return replace(cloud, times_s=cloud.times_s.max() - cloud.times_s)


def turned_frame(frame: Frame) -> Frame:
    """The frame, the times of its points turned whenever they are read."""
    if frame.read_points is None:
        return frame
    return replace(frame, read_points=partial(_read_turned, frame.read_points))


def _read_turned(read: Callable[[], PointCloud]) -> PointCloud:
    return turned(read())


def first_after_s(cloud: PointCloud, stamp_s: float) -> float:
    """Seconds from the stamp of a sweep to its first point, negative where the stamp is that of a later one; 0 where
    the points are counted from another moment: then the stamp is taken as that of the first.
    """
    if cloud.times_s is None or not len(cloud):
        return 0.0
    after_s = cloud.first_s - (stamp_s if cloud.first_s > UNIX_STAMP_S else 0.0)
    turn_s = float(cloud.times_s.max())
    return after_s if abs(after_s + turn_s / 2) <= turn_s else 0.0


def deskewed_frame(frame: Frame, velocity: Floats) -> Frame:
    """The frame, its points deskewed to the moment of its stamp whenever they are read."""
    if frame.read_points is None:
        return frame
    read = partial(_read_deskewed, frame.read_points, frame.stamp_s, tuple(velocity.tolist()))
    return replace(frame, read_points=read)


def _read_deskewed(read: Callable[[], PointCloud], stamp_s: float, velocity: tuple[float, ...]) -> PointCloud:
    cloud = read()
    return deskewed(cloud, np.array(velocity), -first_after_s(cloud, stamp_s))


def velocities(poses: Floats, times_s: Floats) -> Floats:
    """The twist a second (N, 6) of each of N poses (N, 4, 4), in its own axes, from the one before to the one after."""
    if len(poses) < 2:
        return np.zeros((len(poses), 6))
    here = np.arange(len(poses))
    before, behind = np.maximum(here - 1, 0), np.minimum(here + 1, len(poses) - 1)
    moved = se3.log(se3.inverse(poses[before]) @ poses[behind])
    return np.asarray(moved / (times_s[behind] - times_s[before])[:, None])
