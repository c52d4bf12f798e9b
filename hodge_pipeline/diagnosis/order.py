"""The prior probability that an edge is right, by the order of the vertices, where the graph shows that order matters.

A wrong edge joins any two views; a right one joins views that overlap, in a sequence mostly neighbours, and takes the
place of a wrong one. With f the share of all far pairs that are joined, a share r of near pairs holds q right edges and
(1 - q) f wrong ones, so q = (r - f) / (1 - f), and an edge between them is right with the probability q / r.
"""

from __future__ import annotations

import numpy as np

from hodge_pipeline.diagnosis.result import Cycles
from hodge_pipeline.types import Floats, Ints

FLOOR, CEILING = 0.05, 0.98
FAR_SHARE = 0.25
"""Pairs further apart than this share of the vertices give the rate at which any two views are joined."""
LEAST_ODDS = 2.0
"""Of neighbours in order to be joined, in units of those of far pairs, for the order to count."""
DOUBTED = 2
SHARE_ROUNDS = 30
FEW = 20
"""Edges of a gap at which the usual share of right edges weighs as much as their own."""
TRIED_FROM = 0.1
"""Share of the far pairs that are joined."""
LEAST_DEGREE = 4
"""Mean number of edges at a view."""


def order_prior(edges: Ints, vertex_count: int) -> Floats:
    """The probability (E,) that an edge is right, from its gap |i − j|.

    All are equal where neighbours are hardly more often joined than far pairs. Vertex rows are the order.
    """
    gap = np.abs(edges[:, 1] - edges[:, 0])
    bounds = _bounds(vertex_count)
    place = np.searchsorted(bounds, gap, side="right") - 1
    joined = np.bincount(np.maximum(place, 0), minlength=len(bounds) - 1)[: len(bounds) - 1]
    pairs = np.array([_pairs(low, high, vertex_count) for low, high in zip(bounds[:-1], bounds[1:], strict=True)])
    rate = np.minimum(joined / np.maximum(pairs, 1), 1.0)
    far = _far_rate(gap, vertex_count)
    # by odds, which work where most pairs are joined too, with a few more missing neighbours: it may be chance
    missed = 1 - rate[0] + DOUBTED / max(pairs[0], 1)
    if rate[0] * (1 - far) < LEAST_ODDS * far * missed or not joined.any():
        return np.full(len(edges), 0.5)
    right = np.maximum(rate - far, 0) / (1 - far)
    share = np.clip(right / np.maximum(rate, 1e-12), FLOOR, CEILING)
    return np.asarray(share[np.maximum(place, 0)])


def prior_by_cycles(edges: Ints, vertex_count: int, cycles: Cycles) -> Floats:
    """The probability (E,) that an edge is right, from its gap and from the triangles that close: where all pairs are
    joined, the rate of joined pairs is uninformative.

    A triangle closes where its three edges are right, so that each gap's share is that of its triangles that close
    over what the other two edges let expect. All are equal where neighbours are hardly more often right.
    """
    bounds = _bounds(vertex_count)
    place = np.maximum(np.searchsorted(bounds, np.abs(edges[:, 1] - edges[:, 0]), side="right") - 1, 0)
    triangles = np.flatnonzero(cycles.loops.lengths == 3)
    sides = place[cycles.loops.select(triangles).edge.reshape(-1, 3)]
    closing = np.bincount(sides.ravel(), np.repeat(cycles.closes[triangles], 3), len(bounds))
    share = np.full(len(bounds), 0.5)
    for _ in range(SHARE_ROUNDS):
        others = share[sides[:, [1, 0, 0]]] * share[sides[:, [2, 2, 1]]]
        expected = np.bincount(sides.ravel(), others.ravel(), len(bounds))
        observed = np.clip(closing / np.maximum(expected, 1e-9), FLOOR, CEILING)
        share = np.sqrt(share * observed)  # half a step, since whole ones swing
    odds = share / (1 - share)
    is_informative = bool(len(triangles)) and odds[0] >= LEAST_ODDS * odds[place].mean()
    return share[place] if is_informative else np.full(len(edges), 0.5)


def right_by_gap(edges: Ints, vertex_count: int, cycles: Cycles, usual: float) -> Floats:
    """The probability (E,) that an edge is right, from the cycles that close over edges of its gap |i − j|.

    For graphs of which registration has left out bad edges already, so that the rate of joined pairs is uninformative.
    `usual` holds where no cycle passes. No share exceeds what the number of edges of a gap can support: of n
    edges none of which fails the next one is right with (n + 1) / (n + 2) (Laplace's rule of succession).
    """
    bounds = _bounds(vertex_count)
    place = np.maximum(np.searchsorted(bounds, np.abs(edges[:, 1] - edges[:, 0]), side="right") - 1, 0)
    loops = cycles.loops.select(np.flatnonzero(~cycles.closes))
    row, entry = np.repeat(np.arange(len(loops)), loops.lengths), place[loops.edge]
    passes = np.bincount(place[cycles.loops.edge], minlength=len(bounds))
    number = np.bincount(place, minlength=len(bounds))
    share = np.full(len(bounds), min(usual, CEILING))
    for _ in range(SHARE_ROUNDS):
        # of a cycle that fails at least one edge is wrong (expectation), and each in its share of them (maximisation)
        close = np.exp(np.bincount(row, np.log(share)[entry], len(loops)))
        wrong = np.bincount(entry, ((1 - share)[entry] / (1 - close[row])), len(bounds))
        share = np.clip(1 - (wrong + 1 - usual) / (passes + 1), FLOOR, (number + 1) / (number + 2))
    # few edges give a poor estimate for their gap: a doubtful edge would count as evidence against itself
    trust = number / (number + FEW)
    usual = float(np.clip(usual, FLOOR, CEILING))
    logit = trust * np.log(share / (1 - share)) + (1 - trust) * np.log(usual / (1 - usual))
    return np.asarray(1 / (1 + np.exp(-logit[place])))


def every_pair_tried(edges: Ints, vertex_count: int) -> bool:
    """Whether far pairs are joined so often that registration seems to have been tried on all pairs."""
    if len(edges) < LEAST_DEGREE / 2 * vertex_count:
        return False  # of few views the ends of any loop are a large share of the far pairs
    return _far_rate(np.abs(edges[:, 1] - edges[:, 0]), vertex_count) >= TRIED_FROM


def _far_rate(gap: Ints, vertex_count: int) -> float:
    start = max(int(np.ceil(FAR_SHARE * vertex_count)), 2)
    return float((gap >= start).sum() / max(_pairs(start, vertex_count, vertex_count), 1))


def _bounds(vertex_count: int) -> list[int]:
    bounds = [1, 2, 3, 5]
    while bounds[-1] < vertex_count:
        bounds.append(2 * bounds[-1] - 1)
    return bounds


def _pairs(low: int, high: int, count: int) -> int:
    """Pairs of vertices whose gap is in [low, high)."""
    high = min(high, count)
    return 0 if high <= low else (high - low) * count - (high * (high - 1) - low * (low - 1)) // 2
