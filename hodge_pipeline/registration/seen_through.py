"""Registered pairs tested by free space: a motion that slid along a bare surface fits it, and yet puts what stands
before or beside it where the other camera saw through.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from hodge_pipeline.registration.global_evidence import DepthView, cloud_view, violation
from hodge_pipeline.types import Camera, CloudSet, Edges, Floats, Frame
from hodge_pipeline.types.arrays import evenly

POINTS_PROJECTED = 1000
"""Of a cloud, at most: the standard error of a share of 0.15 is 1 %."""
VIEWS_KEPT = 256
"""Views in memory, 40 kB each with their points; pairs come sorted by their first cloud."""


def depth_cameras(frames: Sequence[Frame]) -> tuple[Camera | None, ...]:
    """The camera of each frame with a depth image, None of the others."""
    return tuple(None if frame.read_depth is None else frame.camera for frame in frames)


def seen_through(registered: Edges, clouds: CloudSet, cameras: Sequence[Camera | None], scale: float = 1.0) -> Floats:
    """The share (P,) of the points in view that the other camera of a pair saw through, the larger of both ways; NaN
    where a frame has no depth image, or they have too little in view of each other.

    `scale` multiplies lengths that are for rooms.
    """

    @lru_cache(maxsize=VIEWS_KEPT)
    def seen(row: int, camera: Camera) -> tuple[DepthView, Floats]:
        points = np.asarray(clouds[row].points_in_cam, float)
        return cloud_view(points, camera, scale), points[evenly(len(points), POINTS_PROJECTED)]

    out = np.full(len(registered), np.nan)
    for at, ((i, j), motion) in enumerate(zip(registered.pairs.tolist(), registered.i_from_j, strict=True)):
        first, second = cameras[i], cameras[j]
        if first is not None and second is not None and registered.correspondences[at]:
            (view_i, points_i), (view_j, points_j) = seen(i, first), seen(j, second)
            out[at] = violation((view_i, view_j), (points_i, points_j), motion, scale)
    return out
