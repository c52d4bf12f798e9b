"""Rotations from the chordal relaxation: a linear least-squares problem in the entries of the matrices.

Martinec and Pajdla 2007; Carlone et al. 2015. It needs no start, and is exact where the edges are consistent.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import bsr_matrix

from hodge_pipeline.errors import GraphError
from hodge_pipeline.solvers.cg import truncated_cg
from hodge_pipeline.solvers.linear import factorise
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
    kappa = problem.kappa[:, None, None]
    diagonal = kappa * np.eye(d)
    forward = -kappa * problem.rotations
    blocks = np.concatenate([diagonal, diagonal, forward, np.swapaxes(forward, 1, 2)])
    matrix = problem.symmetric_pattern.assemble(blocks)
    transposed = np.zeros((problem.count, d, d))
    transposed[free:] = np.swapaxes(pinned, 1, 2)
    onto_tail = -forward @ transposed[problem.head]
    onto_head = -np.swapaxes(forward, 1, 2) @ transposed[problem.tail]
    rhs = problem.at_tail @ onto_tail.reshape(-1, d * d) + problem.at_head @ onto_head.reshape(-1, d * d)
    rhs = rhs[:free].reshape(free * d, d)
    transposed[:free] = _solve(matrix, rhs).reshape(free, d, d)
    out = np.empty_like(transposed)
    out[free:] = pinned
    out[:free] = project(np.swapaxes(transposed[:free], 1, 2))
    return out


def _solve(matrix: bsr_matrix, rhs: Floats) -> Floats:
    """The solution (n, d): of a large system by a single-precision factor and conjugate gradients, for its memory."""
    if matrix.shape[0] < LARGE:
        return factorise(matrix.tocsc(), "NATURAL").solve(rhs)
    try:
        factor = factorise(matrix.astype(np.float32).tocsc(), "NATURAL", single=True)
    except GraphError:
        return factorise(matrix.tocsc(), "NATURAL").solve(rhs)
    found = truncated_cg(
        lambda x: np.asarray(matrix @ x.reshape(rhs.shape)).reshape(-1),
        lambda r: factor.solve(r.reshape(rhs.shape)).reshape(-1),
        -rhs.reshape(-1),
        CG_TOLERANCE,
        MAX_CG_STEPS,
    )
    return found.x.reshape(rhs.shape)
