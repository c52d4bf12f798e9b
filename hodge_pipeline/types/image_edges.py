"""Edges of depth and of colour, by which both are laid on each other."""

from __future__ import annotations

import cv2
import numpy as np

from hodge_pipeline.types import Bytes, Floats32, Ints

FEWEST_EDGES = 100
"""Pixels at depth edges that a frame needs to tell how colour lies on them."""
EDGE_STEP = 0.05
"""Share of the nearer depth by which neighbouring pixels differ at a depth edge."""


def depth_edges(depth_m: Floats32) -> tuple[Ints, Ints, Floats32]:
    """Rows and columns (E,) of pixels of a depth image (H, W) of which the next in the row is clearly nearer or
    farther, and the nearer depth (E,), metres. The edge lies half a column on.
    """
    left, right = depth_m[:, :-1], depth_m[:, 1:]
    nearer = np.minimum(left, right)
    rows, columns = np.nonzero((nearer > 0) & (np.abs(left - right) > EDGE_STEP * nearer))
    return rows, columns, nearer[rows, columns]


def change_along_rows(colour: Bytes) -> Floats32:
    """How much the grey of colours (H, W, 3) changes along the rows (H, W), smoothed over three pixels."""
    grey = cv2.blur(cv2.cvtColor(colour, cv2.COLOR_RGB2GRAY), (3, 3))
    return np.asarray(np.abs(cv2.Sobel(grey, cv2.CV_32F, 1, 0)), np.float32)
