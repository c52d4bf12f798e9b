"""Lay out components that no edge joins side by side, without overlap."""

from __future__ import annotations

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.registration.odometry import REACHES_APART
from hodge_pipeline.types import CloudSet, Floats, Ints


def laid_apart(piece: Ints, piece_from: Floats, clouds: CloudSet) -> Floats:
    """Poses (N, 4, 4) in one world: the first piece begins with the identity at its first frame, each other one
    without a turn, beside the one before it.

    `piece (N,)`, `piece_from (N, 4, 4)`: the piece of each frame and its pose in it. Pieces lie so far apart that
    no cloud reaches another's.
    """
    space = REACHES_APART * clouds.reach_m
    out = np.array(piece_from, float)
    begin_x = -np.inf
    for number in range(int(piece.max(initial=-1)) + 1):
        rows = np.flatnonzero(piece == number)
        out[rows] = se3.inverse(piece_from[rows[0]]) @ piece_from[rows]
        out[rows, 0, 3] += max(0.0, begin_x - float(out[rows, 0, 3].min()))
        begin_x = float(out[rows, 0, 3].max()) + space
    return out
