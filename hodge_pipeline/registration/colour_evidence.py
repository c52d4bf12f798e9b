"""Evidence of colours on a registration: one surface keeps its hue, look-alike places differ in some hues."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from scipy.spatial import cKDTree

from hodge_pipeline import se3
from hodge_pipeline.types import Bytes, CloudSet, Floats, Ints, PointCloud

POINTS_COMPARED = 800
"""Of a cloud, at most: the standard error of the share that conflicts is below 2 %."""
SURFACES_KEPT = 64
"""Trees in memory, 0.1 to 1 MB each; pairs come sorted by their first cloud."""
FEWEST_COMPARED = 100
"""Common points, at least: that standard error is 5 % at most."""
NEAR_SPACINGS = 1.5
"""Distance of points of one surface, at most, in distances between neighbours of a cloud."""
DARK = 20.0
"""Added to 8-bit colours, since ratios of dark ones are noise."""
OTHER_HUE = 0.4
"""Difference of the logarithms of a channel, each over the mean of the three; shading changes all three alike."""


def hue_conflicts(clouds: CloudSet, pairs: Ints, i_from_j: Floats) -> Floats:
    """The share (P,) of common surface points whose hue differs; NaN without colours or with little in common."""
    surface_of = lru_cache(maxsize=SURFACES_KEPT)(lambda row: _surface(clouds[row]))
    out = np.full(len(pairs), np.nan)
    if not any(cloud.colours is not None and cloud.colours.any() for cloud in clouds):
        return out
    for at, ((i, j), motion) in enumerate(zip(pairs.tolist(), i_from_j, strict=True)):
        tree, within_m = surface_of(i)
        source = clouds[j]
        step = max(1, len(source) // POINTS_COMPARED)
        moved = se3.transform(motion, np.asarray(source.points_in_cam[::step], float))
        distance, nearest = tree.query(moved, distance_upper_bound=within_m)
        common = np.isfinite(distance)
        here, there = clouds[i].colours, source.colours
        if common.sum() >= FEWEST_COMPARED and here is not None and there is not None:
            out[at] = _conflict(here[nearest[common]], there[::step][common])
    return out


def _surface(cloud: PointCloud) -> tuple[cKDTree, float]:
    """A cloud's tree, and how near a point of its surface is to one of its points, metres."""
    tree = cKDTree(cloud.points_in_cam)
    some = cloud.points_in_cam[:: max(1, len(cloud) // POINTS_COMPARED)]
    distance, _ = tree.query(some, 2)
    return tree, NEAR_SPACINGS * float(np.median(distance[:, 1]))


def _conflict(first: Bytes, second: Bytes) -> float:
    difference = _hue(first) - _hue(second)
    difference -= np.median(difference, axis=0)  # the white balance of two images
    return float((np.abs(difference).max(axis=1) > OTHER_HUE).mean())


def _hue(colours: Bytes) -> Floats:
    logarithms = np.log(colours.astype(float) + DARK)
    return np.asarray(logarithms - logarithms.mean(axis=1, keepdims=True))
