"""Landmarks matched again where a motion is known roughly: those far from where it puts them are no candidates.

Without a guess a landmark must be like one other and unlike all the rest of the image, which repeated and faint ones
are not. Near a guess it must stand out among its neighbours alone.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.types import Floats, Floats32, Ints

RATIO = 0.9
"""A match is this much nearer than the second nearest of the neighbourhood."""
FAR = 9.0
"""Above any squared distance of unit descriptors."""


class Marked(Protocol):
    """A frame's landmarks (n, 3) in its axes, and their unit descriptors (n, 128)."""

    landmarks: Floats
    descriptors: Floats32


def guided_match(target: Marked, source: Marked, i_from_j: Floats, within_m: float) -> Ints:
    """Rows (M, 2) of landmarks of i and j that are each other's nearest by descriptor among those within `within_m`."""
    if not len(target.landmarks) or not len(source.landmarks):
        return np.zeros((0, 2), np.int64)
    moved = se3.transform(i_from_j, source.landmarks)
    squared = _squared_distances(target.landmarks, moved)
    unlike = np.where(squared < within_m**2, 2.0 - 2.0 * (target.descriptors @ source.descriptors.T), FAR)
    of_source = unlike.argmin(axis=0)
    columns = np.arange(len(of_source))
    nearest = unlike[of_source, columns]
    mutual = (unlike.argmin(axis=1)[of_source] == columns) & (nearest < FAR)
    unlike[of_source, columns] = FAR
    stands_out = nearest < RATIO**2 * unlike.min(axis=0)
    kept = np.flatnonzero(mutual & stands_out)
    return np.stack([of_source[kept], kept], axis=1).astype(np.int64)


def _squared_distances(a: Floats, b: Floats) -> Floats:
    return np.asarray((a**2).sum(axis=1)[:, None] + (b**2).sum(axis=1) - 2.0 * a @ b.T)
