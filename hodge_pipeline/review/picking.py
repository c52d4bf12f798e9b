"""What a click in the scene hits: the line or point seen nearest to its ray."""

from __future__ import annotations

import numpy as np

from hodge_pipeline.types import Floats

REACH_RAD = np.deg2rad(1.2)
"""Angle from the ray within which a click hits: 15 pixels of a view that is 60° and 750 pixels high."""


def nearest_point(origin: Floats, direction: Floats, points: Floats) -> int | None:
    """The row of the point (N, 3) seen nearest to a ray; None where none is within reach or in front."""
    if not len(points):
        return None
    beside, ahead = _seen(np.asarray(origin, float), _unit(direction), np.asarray(points, float))
    return _nearest(beside, ahead)


def nearest_segment(origin: Floats, direction: Floats, segments: Floats) -> int | None:
    """The row of the segment (N, 2, 3) seen nearest to a ray; None where none is within reach or in front."""
    if not len(segments):
        return None
    origin, ray, segments = np.asarray(origin, float), _unit(direction), np.asarray(segments, float)
    start, along = segments[:, 0] - origin, segments[:, 1] - segments[:, 0]
    # the point of each segment nearest to the line of the ray: both projected across the ray
    across_start = start - (start @ ray)[:, None] * ray
    across_along = along - (along @ ray)[:, None] * ray
    size = np.sum(across_along**2, axis=1)
    share = np.clip(-np.sum(across_start * across_along, axis=1) / np.where(size > 0, size, 1.0), 0.0, 1.0)
    beside, ahead = _seen(origin, ray, segments[:, 0] + share[:, None] * along)
    return _nearest(beside, ahead)


def _unit(direction: Floats) -> Floats:
    direction = np.asarray(direction, float)
    return np.asarray(direction / max(float(np.linalg.norm(direction)), 1e-12))


def _seen(origin: Floats, ray: Floats, points: Floats) -> tuple[Floats, Floats]:
    """The angle (N,) between the ray and each point, and how far ahead (N,) it is."""
    away = points - origin
    ahead = away @ ray
    beside = np.linalg.norm(away - ahead[:, None] * ray, axis=1)
    return np.arctan2(beside, ahead), ahead


def _nearest(angle: Floats, ahead: Floats) -> int | None:
    """The row with the least angle; among rows within an eighth of the reach of it, the nearest ahead."""
    within = np.flatnonzero((angle < REACH_RAD) & (ahead > 0))
    if not len(within):
        return None
    close = within[angle[within] <= angle[within].min() + REACH_RAD / 8]
    return int(close[np.argmin(ahead[close])])
