"""Directions in which what two frames share lets them slide on each other, as along a bare wall."""

from __future__ import annotations

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.types import Bools, Edges, Floats

HELD_SPREADS = 2.0
"""Times `Acceptance.min_spread`: below it what normals of both clouds err alike may feign a constraint. In a bare
tunnel at 16 beams, where GICP slides by whole steps of 1.4 m, the weakest direction has 0.004 to 0.011; 95 % of pairs
in the demo's room have 0.02."""


def unheld_steps(edges: Edges, min_spread: float) -> Bools:
    """Where (P,) a step between frames leaves a direction of translation unconstrained, as before a bare wall."""
    return may_slide(edges, HELD_SPREADS * min_spread) & are_steps(edges)


def held_where_sliding(registered: Edges, guesses: Floats, min_spread: float) -> Edges:
    """The table with translations kept at their guesses `i_from_j (P, 4, 4)` along directions in which the surfaces may
    slide (solution remapping, Zhang et al., ICRA 2016).
    """
    weak, directions = weak_directions(registered, HELD_SPREADS * min_spread)
    rows = np.flatnonzero(weak.any(axis=1))
    if not len(rows):
        return registered
    twist = se3.log(se3.inverse(guesses[rows]) @ registered.i_from_j[rows])
    slid = np.einsum("nik,nk,njk,nj->ni", directions[rows], weak[rows].astype(float), directions[rows], twist[:, 3:])
    twist[:, 3:] -= slid
    iterations = np.maximum(registered.iterations[rows], 1)
    return registered.put(rows, i_from_j=guesses[rows] @ se3.exp(twist), iterations=iterations)


def may_slide(registered: Edges, min_spread: float) -> Bools:
    """Where (P,) some direction hardly constrains translation."""
    return np.asarray(weak_directions(registered, min_spread)[0].any(axis=1))


def weak_directions(registered: Edges, min_spread: float) -> tuple[Bools, Floats]:
    """Which directions (P, 3) hardly constrain translation, and the directions as columns (P, 3, 3), in j's axes."""
    values, vectors = np.linalg.eigh(np.nan_to_num(registered.information[:, 3:, 3:]))
    return np.asarray(np.maximum(values, 0.0) < min_spread * values.sum(axis=1, keepdims=True)), vectors


def are_steps(registered: Edges) -> Bools:
    """Where (P,) a pair is a step: of two frames that follow each other, among those that any pair has."""
    rank = np.searchsorted(np.unique(registered.pairs), registered.pairs)
    return np.asarray(np.abs(rank[:, 0] - rank[:, 1]) == 1)
