"""Rotations from the chordal relaxation: a linear least-squares problem in the entries of the matrices.

Martinec and Pajdla 2007; Carlone et al. 2015. It needs no start, and is exact where the edges are consistent.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.sparse import bsr_matrix

from hodge_pipeline.complex.components import connected_components
from hodge_pipeline.errors import GraphError
from hodge_pipeline.solvers.cg import solved_columns
from hodge_pipeline.solvers.direct import SECONDS_A_PRODUCT
from hodge_pipeline.solvers.elimination import Elimination, independent_set
from hodge_pipeline.solvers.linear import factorise_blocks
from hodge_pipeline.solvers.problem import Problem, make_problem, pinned_vertices
from hodge_pipeline.solvers.rotations import project
from hodge_pipeline.types import Floats, Ints

LARGE = 60_000
"""Unknowns above which the factor is kept in single precision."""
MULTILEVEL_SECONDS_AN_EDGE = 2.5e-6
"""Where a factorisation takes longer, by the count of its products, the multilevel scheme takes its place."""
AFFORDABLE_S, NOISY = 0.3, 0.1
"""So long a factorisation is worth it where the edges miss by more, as a mean square of 2 sin(θ/2) √2: 0.2 rad. Up to
there both starts lead to the same minimum; with more noise the chordal one does so more often.
"""
CG_TOLERANCE, MAX_CG_STEPS = 1e-5, 50

COARSEST = 500
"""Vertices: so few are solved in milliseconds."""
LEAST_COARSENING = 0.8
"""Of the vertices: a level that leaves more costs more than it saves."""
SWEEPS = 8
DAMPING = 0.7
"""Of a step to the neighbours' mean: whole steps would swing on graphs without odd cycles."""


def initial_rotations(problem: Problem, pinned: Floats) -> Floats:
    """Rotations (n, d, d) to start from: the chordal ones, or those of the multilevel scheme where that is cheaper and
    as good.

    `pinned (n − free, d, d)` are the rotations of the pinned vertices.
    """
    factor_s = SECONDS_A_PRODUCT * problem.dimension**3 * problem.structure.elimination.work
    if factor_s <= MULTILEVEL_SECONDS_AN_EDGE * len(problem.kappa):
        return chordal_rotations(problem, pinned)
    whole = RotationGraph(problem.count, problem.tail, problem.head, problem.rotations, problem.kappa)
    found = multilevel_rotations(whole, _chordal_alone)
    if factor_s < AFFORDABLE_S and _misfit(whole, found) > NOISY:
        return chordal_rotations(problem, pinned)
    component = connected_components(np.stack([problem.tail, problem.head], axis=1), problem.count)
    held = np.arange(problem.free_count, problem.count)
    turn = np.broadcast_to(np.eye(problem.dimension), (component.max() + 1, *pinned.shape[1:])).copy()
    turn[component[held]] = pinned @ np.swapaxes(found[held], 1, 2)
    found = np.asarray(turn[component] @ found)
    found[held] = pinned
    return found


def _misfit(graph: RotationGraph, rotations: Floats) -> float:
    """The weighted mean of ‖R_j − R_i R_ij‖²."""
    missed = rotations[graph.head] - rotations[graph.tail] @ graph.turns
    return float(np.average(np.einsum("eij,eij->e", missed, missed), weights=graph.weights))


def _chordal_alone(graph: RotationGraph) -> Floats:
    """The chordal rotations of a graph, in a gauge of their own."""
    edges = np.stack([graph.tail, graph.head], axis=1)
    held = pinned_vertices(connected_components(edges, graph.count), np.zeros(0, np.int64))
    flat = np.zeros((len(edges), graph.turns.shape[-1]))
    problem = make_problem(edges, graph.turns, flat, graph.weights, graph.weights, held)
    d = problem.dimension
    eyes = np.broadcast_to(np.eye(d), (problem.count - problem.free_count, d, d))
    out = np.empty((graph.count, d, d))
    out[problem.order] = chordal_rotations(problem, eyes)
    return out


def chordal_rotations(problem: Problem, pinned: Floats) -> Floats:
    """Rotations (n, d, d) that minimise Σ κ‖R_jᵀ − R_ijᵀ R_iᵀ‖² without the constraint, then projected.

    `pinned (n − free, d, d)` are the rotations of the pinned vertices.
    """
    d, free = problem.dimension, problem.free_count
    matrix = problem.structure.symmetric_pattern.assemble(lambda edges: _blocks(problem, edges), (d, d))
    transposed = np.zeros((problem.count, d, d))
    transposed[free:] = np.swapaxes(pinned, 1, 2)
    rhs = np.zeros((problem.count, d, d))
    tail, head = problem.tail, problem.head
    onto_pinned = np.flatnonzero((tail >= free) | (head >= free))
    weighted = problem.kappa[onto_pinned, None, None] * problem.rotations[onto_pinned]
    tail, head = tail[onto_pinned], head[onto_pinned]
    np.add.at(rhs, tail, weighted @ transposed[head])
    np.add.at(rhs, head, np.swapaxes(weighted, 1, 2) @ transposed[tail])
    transposed[:free] = _solve(problem.structure.elimination, matrix, rhs[:free].reshape(free * d, d)).reshape(
        free, d, d
    )
    out = np.empty_like(transposed)
    out[free:] = pinned
    out[:free] = project(np.swapaxes(transposed[:free], 1, 2))
    return out


def _blocks(problem: Problem, edges: slice) -> Floats:
    """The blocks ii, jj, ij, ji (4, m, d, d) of some edges."""
    kappa = problem.kappa[edges, None, None]
    diagonal = kappa * np.eye(problem.dimension)
    forward = -kappa * problem.rotations[edges]
    return np.stack([diagonal, diagonal, forward, np.swapaxes(forward, 1, 2)])


def _solve(plan: Elimination, matrix: bsr_matrix, rhs: Floats) -> Floats:
    """The solution (n, d): of a large system by a single-precision factor and conjugate gradients, for its memory."""
    if matrix.shape[0] < LARGE:
        return factorise_blocks(plan, matrix).solve(rhs)
    try:
        factor = factorise_blocks(plan, matrix, single=True)
    except GraphError:
        return factorise_blocks(plan, matrix).solve(rhs)
    return solved_columns(lambda x: np.asarray(matrix @ x), factor.solve, rhs, CG_TOLERANCE, MAX_CG_STEPS)


@dataclass(frozen=True)
class RotationGraph:
    """Relative rotations of `count` vertices: `tail`, `head (E,)`, `turns (E, d, d)` = R_ij, `weights (E,)` = κ."""

    count: int
    tail: Ints
    head: Ints
    turns: Floats
    weights: Floats


def multilevel_rotations(graph: RotationGraph, solve_coarsest: Callable[[RotationGraph], Floats]) -> Floats:
    """Rotations (n, d, d) near those that agree best with the edges, each component in a gauge of its own."""
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
