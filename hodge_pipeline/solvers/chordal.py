"""Rotations from the chordal relaxation: a linear least-squares problem in the entries of the matrices.

Martinec and Pajdla 2007; Carlone et al. 2015. It needs no start, and is exact where the edges are consistent.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import bsr_matrix

from hodge_pipeline.errors import GraphError
from hodge_pipeline.solvers.cg import truncated_cg
from hodge_pipeline.solvers.elimination import Elimination
from hodge_pipeline.solvers.linear import factorise_blocks
from hodge_pipeline.solvers.problem import Problem
from hodge_pipeline.solvers.rotations import project
from hodge_pipeline.types import Floats

LARGE = 60_000
"""Unknowns above which the factor is kept in single precision."""
CG_TOLERANCE, MAX_CG_STEPS = 1e-5, 50


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
    found = truncated_cg(
        lambda x: np.asarray(matrix @ x.reshape(rhs.shape)).reshape(-1),
        lambda r: factor.solve(r.reshape(rhs.shape)).reshape(-1),
        -rhs.reshape(-1),
        CG_TOLERANCE,
        MAX_CG_STEPS,
    )
    return found.x.reshape(rhs.shape)
