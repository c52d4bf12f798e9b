"""Two colour images side by side with the SIFT matches between them."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from hodge_pipeline.pairs.sift_matching import CONFIDENCE, MOST_RANSAC_STEPS
from hodge_pipeline.registration.descriptors import match, root_sift
from hodge_pipeline.report.raster import GAP, beside
from hodge_pipeline.types import Bytes, Floats32, Ints

RATIO = 0.8
MAX_FEATURES = 1000
MAX_ERROR_PX = 2.0
FEWEST = 8
ODD_COLOUR, AGREEING_COLOUR = (160, 160, 160), (0, 158, 115)


@dataclass(frozen=True)
class Matched:
    """The picture (H, W, 3), the number of matches, and how many of them one relative pose explains."""

    image: Bytes
    matches: int
    agreeing: int


def side_by_side(first: Bytes, second: Bytes) -> Matched:
    """Two RGB images with a line for each match: green where one relative pose explains it, else grey."""
    canvas = beside([first, second])
    found = [_features(image) for image in (first, second)]
    pairs = match(found[0][1], found[1][1], RATIO)
    agreeing = _agreeing(found[0][0], found[1][0], pairs)
    offset = np.array([first.shape[1] + GAP, 0], np.float32)
    for colour, rows in ((ODD_COLOUR, ~agreeing), (AGREEING_COLOUR, agreeing)):
        for a, b in pairs[rows]:
            start, end = np.round([found[0][0][a], found[1][0][b] + offset]).astype(int).tolist()
            cv2.line(canvas, start, end, colour, 1, cv2.LINE_AA)
    return Matched(canvas, len(pairs), int(agreeing.sum()))


def _features(image: Bytes) -> tuple[Floats32, Floats32]:
    """Pixels (n, 2) and unit descriptors (n, 128)."""
    detector = cv2.SIFT_create(nfeatures=MAX_FEATURES)  # type: ignore[attr-defined]
    points, descriptors = detector.detectAndCompute(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), None)
    if not points:
        return np.zeros((0, 2), np.float32), np.zeros((0, 128), np.float32)
    return np.array([point.pt for point in points], np.float32), root_sift(descriptors.astype(np.uint8))


def _agreeing(first: Floats32, second: Floats32, pairs: Ints) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
    """Where (M,) a match is explained by the fundamental matrix that explains most: the same answer every time."""
    if len(pairs) < FEWEST:
        return np.zeros(len(pairs), bool)
    cv2.setRNGSeed(0)
    model, inlier = cv2.findFundamentalMat(
        first[pairs[:, 0]], second[pairs[:, 1]], cv2.FM_RANSAC, MAX_ERROR_PX, CONFIDENCE, MOST_RANSAC_STEPS
    )
    if model is None or inlier is None or inlier.sum() < FEWEST:
        return np.zeros(len(pairs), bool)
    return np.asarray(inlier.ravel() > 0)
