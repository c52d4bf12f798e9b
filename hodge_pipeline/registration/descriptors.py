"""SIFT descriptors as vectors that compare, and which of two frames' descriptors mean the same."""

from __future__ import annotations

import numpy as np

from hodge_pipeline.types import Bytes, Floats32, Ints

LOWE_RATIO = 0.8
"""A match is this much nearer than the second nearest (Lowe 2004)."""
CONFIDENCE, MOST_RANSAC_STEPS = 0.999, 2000
"""Of a search for the one relative pose of two images that most matches agree with."""


def root_sift(descriptors: Bytes) -> Floats32:
    """Unit vectors (n, 128) whose products compare as histograms should (Arandjelović and Zisserman 2012)."""
    raw = descriptors.astype(np.float32)
    return np.asarray(np.sqrt(raw / np.maximum(raw.sum(axis=1, keepdims=True), 1.0)))


def match(descriptors_i: Floats32, descriptors_j: Floats32, ratio: float) -> Ints:
    """Rows (M, 2) of unit descriptors that are each other's nearest, and by the ratio nearer than the second one."""
    if len(descriptors_i) < 2 or len(descriptors_j) < 2:
        return np.zeros((0, 2), np.int64)
    likeness = descriptors_i @ descriptors_j.T
    nearest = likeness.argmax(axis=1)
    mutual = np.flatnonzero(likeness.argmax(axis=0)[nearest] == np.arange(len(nearest)))
    two_best = np.partition(likeness[mutual], -2, axis=1)[:, -2:]
    distances = np.sqrt(np.maximum(2.0 - 2.0 * two_best, 0.0))
    kept = mutual[distances[:, 1] < ratio * distances[:, 0]]
    return np.stack([kept, nearest[kept]], axis=1).astype(np.int64)
