"""Rotations of a large graph, coarse to fine: aggregates of vertices first, then each vertex from its neighbours.

Each vertex that joins an aggregate's seed by an edge takes its rotation from it; the aggregates' own follow from the
mean edges between them, level by level. What the coarsest graph's rotations are, its solver says.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.sparse import bsr_matrix

from hodge_pipeline.solvers.elimination import independent_set
from hodge_pipeline.solvers.rotations import project
from hodge_pipeline.types import Floats, Ints

COARSEST = 500
"""Vertices: so few are solved in milliseconds."""
LEAST_COARSENING = 0.8
"""Of the vertices: a level that leaves more costs more than it saves."""
SWEEPS = 8
"""Smoothing steps of a level."""
DAMPING = 0.7
"""Of a step to the neighbours' mean: whole steps would swing on graphs without odd cycles."""


@dataclass(frozen=True)
class RotationGraph:
    """Relative rotations of `count` vertices: `tail`, `head (E,)`, `turns (E, d, d)` = R_ij, `weights (E,)` = κ."""

    count: int
    tail: Ints
    head: Ints
    turns: Floats
    weights: Floats


def multilevel_rotations(graph: RotationGraph, solve_coarsest: Callable[[RotationGraph], Floats]) -> Floats:
    """Rotations (n, d, d) near those that agree best with the edges, each component in a gauge of its own.

    `solve_coarsest`: the rotations of a graph of no more than `COARSEST` vertices, or of one that hardly coarsens.
    """
    if graph.count <= COARSEST:
        return solve_coarsest(graph)
    aggregate, inner = _aggregates(graph)
    coarse = _coarsened(graph, aggregate, inner)
    if coarse.count > LEAST_COARSENING * graph.count:
        return solve_coarsest(graph)
    rotations = multilevel_rotations(coarse, solve_coarsest)[aggregate] @ inner
    return _smoothed(graph, rotations)


def _aggregates(graph: RotationGraph) -> tuple[Ints, Floats]:
    """The aggregate (n,) of each vertex, and its rotation (n, d, d) as seen from the aggregate's seed."""
    tail, head, count = graph.tail, graph.head, graph.count
    degree = np.bincount(tail, minlength=count) + np.bincount(head, minlength=count)
    rank = np.random.default_rng(0).permutation(count) - degree * count
    seeds = independent_set(tail, head, np.ones(count, bool), rank)
    aggregate = np.full(count, -1)
    aggregate[seeds] = np.arange(int(seeds.sum()))
    d = graph.turns.shape[-1]
    inner = np.broadcast_to(np.eye(d), (count, d, d)).copy()
    forward, backward = seeds[tail], seeds[head]
    seed = np.concatenate([tail[forward], head[backward]])
    joined = np.concatenate([head[forward], tail[backward]])
    turns = np.concatenate([graph.turns[forward], np.swapaxes(graph.turns[backward], 1, 2)])
    order = np.argsort(np.concatenate([graph.weights[forward], graph.weights[backward]]), kind="stable")
    aggregate[joined[order]] = aggregate[seed[order]]
    inner[joined[order]] = turns[order]
    return aggregate, inner


def _coarsened(graph: RotationGraph, aggregate: Ints, inner: Floats) -> RotationGraph:
    """The graph of the aggregates: all edges between two of them become one, their weighted mean."""
    first, second = aggregate[graph.tail], aggregate[graph.head]
    across = np.flatnonzero(first != second)
    first, second = first[across], second[across]
    turns = inner[graph.tail[across]] @ graph.turns[across] @ np.swapaxes(inner[graph.head[across]], 1, 2)
    flipped = first > second
    turns[flipped] = np.swapaxes(turns[flipped], 1, 2)
    count, d = int(aggregate.max()) + 1, turns.shape[-1]
    keys, edge = np.unique(np.minimum(first, second) * count + np.maximum(first, second), return_inverse=True)
    weights = graph.weights[across]
    total: Floats = np.bincount(edge, weights, len(keys)).astype(float)
    weighted = (weights[:, None, None] * turns).reshape(-1, d * d)
    mean = np.stack([np.bincount(edge, column, len(keys)) for column in weighted.T], axis=1) / total[:, None]
    tail, head = np.divmod(keys, count)
    return RotationGraph(count, tail, head, project(mean.reshape(-1, d, d)), total)


def _smoothed(graph: RotationGraph, rotations: Floats) -> Floats:
    """The rotations after some damped steps, each towards the mean that the neighbours predict."""
    count, d = graph.count, rotations.shape[-1]
    rows, columns = np.concatenate([graph.head, graph.tail]), np.concatenate([graph.tail, graph.head])
    weighted = graph.weights[:, None, None] * graph.turns
    blocks = np.concatenate([np.swapaxes(weighted, 1, 2), weighted])
    order = np.argsort(rows, kind="stable")
    indptr = np.searchsorted(rows[order], np.arange(count + 1))
    neighbours = bsr_matrix((blocks[order], columns[order], indptr), shape=(count * d, count * d))
    degree = np.bincount(rows, np.concatenate([graph.weights, graph.weights]), count)
    share = (DAMPING / np.where(degree > 0, degree, 1.0))[:, None, None]
    x = np.ascontiguousarray(np.swapaxes(rotations, 1, 2))
    for _ in range(SWEEPS):
        predicted = (neighbours @ x.reshape(count * d, d)).reshape(x.shape)
        x = (1 - DAMPING * (degree > 0))[:, None, None] * x + share * predicted
    return project(np.swapaxes(x, 1, 2))
