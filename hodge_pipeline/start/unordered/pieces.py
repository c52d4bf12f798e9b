"""Pieces that no evidence joins, laid beside each other so that none lies in another."""

from __future__ import annotations

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.types import CloudSet, Floats, Ints

SPACE_BETWEEN_PIECES_M = 20.0


def laid_apart(piece: Ints, piece_from: Floats, clouds: CloudSet) -> Floats:
    """Poses (N, 4, 4) in one world: each piece begins with the identity at its first frame, beside the one before it.

    `piece (N,)`, `piece_from (N, 4, 4)`: the piece of each frame and its pose in it. Between two pieces lie 20 m more
    than any cloud reaches.
    """
    space = SPACE_BETWEEN_PIECES_M + 2 * _reach_m(clouds)
    out = np.array(piece_from, float)
    begin_x = 0.0
    for number in range(int(piece.max(initial=-1)) + 1):
        rows = np.flatnonzero(piece == number)
        out[rows] = se3.inverse(piece_from[rows[0]]) @ piece_from[rows]
        out[rows, 0, 3] += begin_x - min(0.0, float(out[rows, 0, 3].min()))
        begin_x = float(out[rows, 0, 3].max()) + space
    return out


def _reach_m(clouds: CloudSet) -> float:
    return max((float(np.linalg.norm(c.points_in_cam, axis=1).max()) for c in clouds if len(c)), default=0.0)
