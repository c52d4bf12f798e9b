"""Rotations from the chordal relaxation: a linear least-squares problem in the entries of the matrices.

Martinec and Pajdla 2007; Carlone et al. 2015. It needs no start, and is exact where the edges are consistent. Where its
factorisation would be dear, the multilevel scheme (solvers/multilevel.py) takes its place.
"""

from __future__ import annotations

import numpy as np

from hodge_pipeline.complex.components import connected_components
from hodge_pipeline.solvers.direct import SECONDS_A_PRODUCT
from hodge_pipeline.solvers.linear import factorise_blocks
from hodge_pipeline.solvers.multilevel import RotationGraph, multilevel_rotations
from hodge_pipeline.solvers.problem import Problem, make_problem, pinned_vertices
from hodge_pipeline.solvers.rotations import project
from hodge_pipeline.types import Floats

MULTILEVEL_SECONDS_AN_EDGE = 2.5e-6
"""Where a factorisation takes longer, by the count of its products, the multilevel scheme takes its place."""
AFFORDABLE_S, NOISY = 0.3, 0.1
"""So long a factorisation is worth it where the edges miss by more, as a mean square of 2 sin(θ/2) √2: 0.2 rad. Up to
there both starts lead to the same minimum; with more noise the chordal one does so more often.
"""


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
    factor = factorise_blocks(problem.structure.elimination, matrix)
    transposed[:free] = factor.solve(rhs[:free].reshape(free * d, d)).reshape(free, d, d)
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
