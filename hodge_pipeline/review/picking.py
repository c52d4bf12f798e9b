"""What a click in the scene hits: the line or point seen nearest to its ray."""

from __future__ import annotations

import numpy as np

from hodge_pipeline.types import Floats

REACH_RAD = np.deg2rad(1.2)
"""Angle from the ray within which a click hits: 15 pixels of a view that is 60° and 750 pixels high."""


def nearest_point(origin: Floats, direction: Floats, points: Floats) -> int | None:
    """The row of the point (N, 3) seen nearest to a ray; None where none is within reach or in front."""
    return nearest_segment(origin, direction, np.repeat(np.reshape(points, (-1, 1, 3)), 2, axis=1))


def nearest_segment(origin: Floats, direction: Floats, segments: Floats) -> int | None:
    """The row of the segment (N, 2, 3) seen nearest to a ray; None where none is within reach or in front. Among rows
    within an eighth of the reach of the least angle it is the nearest ahead.
    """
    ray, segments = np.asarray(direction, float), np.asarray(segments, float)
    ray = ray / max(float(np.linalg.norm(ray)), 1e-12)
    start, along = segments[:, 0] - origin, segments[:, 1] - segments[:, 0]
    # the point of each segment nearest to the line of the ray: both projected across the ray
    across_start = start - (start @ ray)[:, None] * ray
    across_along = along - (along @ ray)[:, None] * ray
    size = np.sum(across_along**2, axis=1)
    share = np.clip(-np.sum(across_start * across_along, axis=1) / np.where(size > 0, size, 1.0), 0.0, 1.0)
    away = start + share[:, None] * along
    ahead = away @ ray
    angle = np.arctan2(np.linalg.norm(away - ahead[:, None] * ray, axis=1), ahead)
    within = np.flatnonzero((angle < REACH_RAD) & (ahead > 0))
    if not len(within):
        return None
    close = within[angle[within] <= angle[within].min() + REACH_RAD / 8]
    return int(close[np.argmin(ahead[close])])
