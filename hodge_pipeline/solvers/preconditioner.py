"""A direct factor of rotations and translations together, for graphs like a chain.

There long levers couple rotations to translations, which the scalar Laplacian of κ cannot see, and fill is so small
that the factor costs no more than some tens of CG steps.
"""

from __future__ import annotations

import numpy as np

from hodge_pipeline.solvers.cg import Operator
from hodge_pipeline.solvers.linear import factorise
from hodge_pipeline.solvers.problem import Problem
from hodge_pipeline.solvers.rotations import lever
from hodge_pipeline.types import Floats

CHAIN_FILL_PER_VERTEX = 12.0


def is_chain_like(problem: Problem) -> bool:
    """Whether the scalar factor has so little fill that the joint one is cheap."""
    return problem.rotation_factor.fill <= CHAIN_FILL_PER_VERTEX * max(problem.free_count, 1)


def joint_preconditioner(problem: Problem, arms: Floats) -> Operator:
    """The map r -> H⁻¹ r on (free · p,), H half the Hessian of consistent edges with the translations eliminated.

    `arms (E, d)` are R_i t_ij.
    """
    p, d, free = problem.tangent_size, problem.dimension, problem.free_count
    tau, kappa = problem.tau[:, None, None], problem.kappa[:, None, None]
    coupling = tau * lever(arms)
    blocks = np.zeros((4, len(tau), p + d, p + d))
    ii, jj, ij, ji = blocks
    jj[:, :p, :p], jj[:, p:, p:] = 2 * kappa * np.eye(p), tau * np.eye(d)
    ii[:], ij[:] = jj, -jj
    ii[:, :p, :p] += np.swapaxes(lever(arms), 1, 2) @ coupling
    ii[:, p:, :p], ii[:, :p, p:] = -coupling, -np.swapaxes(coupling, 1, 2)
    ij[:, :p, p:] = np.swapaxes(coupling, 1, 2)
    ji[:] = np.swapaxes(ij, 1, 2)
    matrix = problem.symmetric_pattern.assemble(blocks.reshape(-1, p + d, p + d))
    solve = factorise(matrix.tocsc(), "NATURAL").solve

    def apply(r: Floats) -> Floats:
        rhs = np.zeros((free, p + d))
        rhs[:, :p] = r.reshape(free, p)
        return np.ascontiguousarray(solve(rhs.reshape(-1)).reshape(free, p + d)[:, :p]).reshape(-1)

    return apply
