"""Loops of one place, which count once however many agree, and corridors of places; in units of `Chain.places`."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from hodge_pipeline.complex.components import connected_components
from hodge_pipeline.types import Floats, Ints

ADJACENT = 2.0
"""Distance in places up to which places are adjacent: a corridor that is mistaken for another counts once."""
LONGEST_CORRIDOR = 5.0
"""Most places of a mistaken corridor, of 20 steps or more each: a longer run is cut. Without a limit none of 52 loops
of a second lap counted, each of which says nothing alone beside 160 m of drift.
"""


def loops_at_place(ends: Floats) -> Floats:
    """How many loops (M,), itself included, are of the same place as each; `ends (M, 2)` as in `Chain.places`."""
    return np.asarray(cKDTree(ends).query_ball_point(ends, 1.0, p=np.inf, return_length=True), float)


def one_of_each_place(ends: Floats) -> Ints:
    """Rows of one loop of each place, ascending, those with most loops near first; `ends (M, 2)` in places."""
    tree, free, out = cKDTree(ends), np.ones(len(ends), bool), []
    for row in np.argsort(-loops_at_place(ends), kind="stable").tolist():
        if free[row]:
            out.append(row)
            free[tree.query_ball_point(ends[row], 1.0, p=np.inf)] = False
    return np.sort(np.array(out, np.int64))


def corridors(ends: Floats) -> Ints:
    """The corridor (K,) of each loop: a run of adjacent places, cut to `LONGEST_CORRIDOR`; `ends (K, 2)` in places."""
    run = connected_components(cKDTree(ends).query_pairs(ADJACENT, p=np.inf, output_type="ndarray"), len(ends))
    order = np.argsort(run, kind="stable")
    first = np.unique(run[order], return_index=True)[1]
    low, high = (reduce.reduceat(ends[order], first) for reduce in (np.minimum, np.maximum))
    axis = (high - low).argmax(axis=1)[run]
    along = ends[np.arange(len(ends)), axis] - low[run, axis]
    parts = np.stack([run, (along / LONGEST_CORRIDOR).astype(np.int64)], axis=1)
    return np.unique(parts, axis=0, return_inverse=True)[1].reshape(-1)
