"""How many matches of two frames' features one relative pose explains."""

from __future__ import annotations

import cv2
import numpy as np

from hodge_pipeline.types import Camera, Floats32

CONFIDENCE = 0.999
MOST_RANSAC_STEPS = 2000
MAX_ERROR_PX = 1.5
"""From the epipolar line, for a match to be an inlier."""


def count_inliers(points_i: Floats32, points_j: Floats32, cameras: tuple[Camera | None, Camera | None]) -> int:
    """How many matched points (M, 2) one relative pose explains: the same answer every time.

    With two cameras the points are slopes of rays and the model is an essential matrix (RANSAC, five points); else
    they are pixels and it is a fundamental matrix.
    """
    if len(points_i) < 8:
        return 0
    first, second = cameras
    if first is not None and second is not None:
        focal_px = np.mean(np.abs([first.fx, first.fy, second.fx, second.fy]))
        limit = MAX_ERROR_PX / float(focal_px)
        model, inlier = cv2.findEssentialMat(
            points_i, points_j, np.eye(3), method=cv2.RANSAC, prob=CONFIDENCE, threshold=limit,
            maxIters=MOST_RANSAC_STEPS,
        )  # fmt: skip
    else:
        model, inlier = cv2.findFundamentalMat(
            points_i, points_j, cv2.FM_RANSAC, MAX_ERROR_PX, CONFIDENCE, MOST_RANSAC_STEPS
        )
    return 0 if model is None or inlier is None else int(np.count_nonzero(inlier))
