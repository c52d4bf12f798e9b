"""Parts of a model that share no points, or too few: nothing tells how they lie to each other."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_array

from hodge_pipeline.complex.components import connected_components
from hodge_pipeline.refine.reprojection_cost import named
from hodge_pipeline.types import Bools, Ints
from hodge_pipeline.types.tracked_model import TrackedModel

LEAST_SHARED = 3
"""Points that fix a pose."""


def pieces_doubt(model: TrackedModel) -> str:
    """Which bodies of a model share too few points with its largest piece; "" where none does."""
    names = [str(name) for name, apart in zip(model.body_names, apart_from_largest(model), strict=True) if apart]
    if not names:
        return ""
    return f"in doubt, since {named(names)} share{'s' * (len(names) == 1)} no points with the others, or too few"


def apart_from_largest(model: TrackedModel) -> Bools:
    """Bodies (B,) that points do not tie to the largest piece: with fewer than `LEAST_SHARED` points that other bodies
    see, in a piece of their own, or in a group that shares fewer with all others, as two rows that one point joins.
    """
    found = _tied(model)
    largest_piece = found.piece == np.argmax(np.bincount(found.piece, found.enough))
    largest_group = found.group == np.argmax(np.bincount(found.group, found.enough))
    return np.asarray(~found.enough | ~largest_piece | (found.loose & ~largest_group))


def parts(model: TrackedModel) -> Ints:
    """The part (B,) of each body: groups that share fewer than `LEAST_SHARED` points with all others are each one, as
    is what else of a piece hangs together; −1 of bodies that see too few points with others.
    """
    found = _tied(model)
    kinds = np.stack([found.piece, np.where(found.loose, found.group, -1)], axis=1)[found.enough]
    out = np.full(len(found.enough), -1)
    out[found.enough] = np.unique(kinds, axis=0, return_inverse=True)[1].ravel()
    return out


class _Tied(NamedTuple):
    """Of each body (B,): whether it sees enough points with others, its piece, its group, and whether this is loose."""

    enough: Bools
    piece: Ints
    group: Ints
    loose: Bools


def _tied(model: TrackedModel) -> _Tied:
    quality, count = model.quality, len(model.body_names)
    seen = np.unique(np.stack([model.body_of_frame[quality.keypoints[:, 0]], quality.point_rows], axis=1), axis=0)
    while True:
        shared = np.bincount(seen[:, 1], minlength=quality.points)[seen[:, 1]] > 1
        enough = np.bincount(seen[shared, 0], minlength=count) >= LEAST_SHARED
        kept = shared & enough[seen[:, 0]]
        if kept.all():
            break
        seen = seen[kept]
    piece = connected_components(seen + np.array([0, count]), count + quality.points)[:count]
    group, ties = _groups(seen, (count, quality.points))
    return _Tied(enough, piece, group, (ties < LEAST_SHARED)[group])


def _groups(seen: Ints, shape: tuple[int, int]) -> tuple[Ints, Ints]:
    """The group (B,) of each body, and how many points each of the G groups shares with others (G,), from who sees what
    (N, 2), of B bodies and P points. Two groups that share `LEAST_SHARED` points are one.
    """
    group = np.arange(shape[0])
    while True:
        size = int(group.max()) + 1
        rows = np.unique(np.stack([group[seen[:, 0]], seen[:, 1]]), axis=1)
        sees = csr_array((np.ones(rows.shape[1], np.int64), tuple(rows)), (size, shape[1]))
        shared = (sees @ sees.T >= LEAST_SHARED).tocoo()
        merged = connected_components(np.stack([shared.row, shared.col], axis=1), size)
        if int(merged.max()) + 1 == size:
            return group, sees @ (sees.sum(axis=0) > 1)
        group = merged[group]
