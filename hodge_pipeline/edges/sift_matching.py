"""Matches of two frames' features, and those of them that one relative pose explains."""

from __future__ import annotations

import cv2
import numpy as np

from hodge_pipeline.types import Camera, Floats32, Ints

CONFIDENCE = 0.999
MOST_RANSAC_STEPS = 2000


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


def count_inliers(
    points_i: Floats32, points_j: Floats32, cameras: tuple[Camera | None, Camera | None], max_error_px: float
) -> int:
    """How many matched points (M, 2) one relative pose explains: the same answer every time.

    With two cameras the points are slopes of rays and the model is an essential matrix (RANSAC, five points); else
    they are pixels and it is a fundamental matrix.
    """
    if len(points_i) < 8:
        return 0
    first, second = cameras
    if first is not None and second is not None:
        focal_px = np.mean(np.abs([first.fx, first.fy, second.fx, second.fy]))
        limit = max_error_px / float(focal_px)
        model, inlier = cv2.findEssentialMat(
            points_i, points_j, np.eye(3), method=cv2.RANSAC, prob=CONFIDENCE, threshold=limit,
            maxIters=MOST_RANSAC_STEPS,
        )  # fmt: skip
    else:
        model, inlier = cv2.findFundamentalMat(
            points_i, points_j, cv2.FM_RANSAC, max_error_px, CONFIDENCE, MOST_RANSAC_STEPS
        )
    return 0 if model is None or inlier is None else int(np.count_nonzero(inlier))
