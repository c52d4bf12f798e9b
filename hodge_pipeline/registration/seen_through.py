"""Registered pairs tested by free space: a motion that slid along a bare surface fits it, and yet puts what stands
before or beside it where the other camera saw through.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from hodge_pipeline.types import Bools, CloudSet, Edges, Floats
from hodge_pipeline.types.arrays import evenly

if TYPE_CHECKING:
    from hodge_pipeline.registration.global_evidence import DepthView

POINTS_PROJECTED = 1000
"""Of a cloud, at most: the standard error of a share of 0.15 is 1 %."""
VIEWS_KEPT = 256
"""Views in memory, 40 kB each with their points; pairs come sorted by their first cloud."""


def with_seen_through(registered: Edges, clouds: CloudSet, scale: float = 1.0) -> Edges:
    """The table with the share (P,) of the points in view that the other camera of a pair saw through, the larger of
    both ways; NaN where a cloud is of no depth image, they have too little in view of each other, or landmarks gave
    the motion: these do not slide, and what a rolling shutter bends may seem seen through.

    `scale` multiplies lengths that are for rooms.
    """
    from hodge_pipeline.registration.global_evidence import cloud_view, violation  # scipy, which workers do without

    @lru_cache(maxsize=VIEWS_KEPT)
    def seen(row: int) -> tuple[DepthView, Floats] | None:
        cloud = clouds[row]
        if cloud.depth_camera is None:
            return None
        points = np.asarray(cloud.points_in_cam, float)
        return cloud_view(points, cloud.depth_camera, scale), points[evenly(len(points), POINTS_PROJECTED)]

    out = np.full(len(registered), np.nan)
    for at in np.flatnonzero((registered.correspondences > 0) & ~registered.by_landmarks).tolist():
        first, second = map(seen, registered.pairs[at].tolist())
        if first is not None and second is not None:
            (view_i, points_i), (view_j, points_j) = first, second
            out[at] = violation((view_i, view_j), (points_i, points_j), registered.i_from_j[at], scale)
    return replace(registered, seen_through=out)


def is_refuted(registered: Edges, most: float | None) -> Bools:
    """Where (P,) a camera saw through more than the share `most`; nowhere without a limit."""
    if most is None:
        return np.zeros(len(registered), bool)
    return np.asarray(registered.seen_through > most)  # false for NaN
