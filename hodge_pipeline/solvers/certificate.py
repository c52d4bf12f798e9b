"""Whether a minimum of the isotropic objective is the global one: the dual certificate of SE-Sync (theorem 7).

At a critical point, Q − Λ ⪰ 0 proves it. Q − Λ is factorised together with the translations that Q eliminates, so the
matrix stays as sparse as the graph; by Sylvester's law its negative pivots are its negative eigenvalues.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import bsr_matrix, csc_matrix, diags_array

from hodge_pipeline.solvers.linear import negative_pivots
from hodge_pipeline.solvers.problem import BlockPattern, Problem
from hodge_pipeline.types import Floats

RELATIVE_SHIFTS = (1e-10, 1e-7)
"""ε over κ's scale, the second where the first is lost in rounding; local minima have eigenvalues far below both."""
RELATIVE_GAP = 1e-6
"""ε is taken larger where even then the bound on the gap stays below this share of F."""


@dataclass(frozen=True)
class Certificate:
    """The answer: `optimal`, with `smallest_eigenvalue ≥ −shift` and `gap_bound` ≥ F − F_optimal when it is.

    `negative_eigenvalues` counts those of Q − Λ + shift · I when it is not; −1 where the factorisation broke down.
    """

    optimal: bool
    shift: float
    gap_bound: float
    negative_eigenvalues: int
    note: str


def certificate_matrix(problem: Problem, rotations: Floats, translations: Floats) -> bsr_matrix:
    """[[M − Λ, Vᵀ], [V, L_τ]] on (rotation rows, translation) of each vertex, in the problem's order.

    Its Schur complement over the translations is Q − Λ (SE-Sync, equations 15 and 23).
    """
    d, count = problem.dimension, problem.count
    size = d + 1
    rows = np.stack([problem.tail, problem.head, problem.tail, problem.head])
    columns = np.stack([problem.tail, problem.head, problem.head, problem.tail])
    pattern = BlockPattern.of(rows, columns, (count, count))
    matrix = pattern.assemble(lambda edges: _blocks(problem, edges), (size, size))
    stacked = np.concatenate([np.swapaxes(rotations, 1, 2), translations[:, None, :]], axis=1)
    image = (matrix @ stacked.reshape(-1, d)).reshape(count, size, d)
    multiplier = image[:, :d] @ rotations
    diagonal = np.zeros((count, size, size))
    diagonal[:, :d, :d] = 0.5 * (multiplier + np.swapaxes(multiplier, 1, 2))
    vertices = np.arange(count + 1, dtype=np.int32)
    return (matrix - bsr_matrix((diagonal, vertices[:-1], vertices), shape=matrix.shape)).tobsr((size, size))


def _blocks(problem: Problem, edges: slice) -> Floats:
    """The blocks ii, jj, ij, ji (4, m, d + 1, d + 1) of some edges, rotation rows first."""
    d, tau, kappa = problem.dimension, problem.tau[edges], problem.kappa[edges, None, None]
    moved = problem.translations[edges]
    blocks = np.zeros((4, len(tau), d + 1, d + 1))
    ii, jj, ij, ji = blocks
    ii[:, :d, :d] = kappa * np.eye(d) + tau[:, None, None] * (moved[:, :, None] * moved[:, None, :])
    jj[:, :d, :d] = kappa * np.eye(d)
    ij[:, :d, :d] = -kappa * problem.rotations[edges]
    ii[:, d, d] = jj[:, d, d] = tau
    ij[:, d, d] = -tau
    arm = tau[:, None] * moved
    ii[:, :d, d] = ii[:, d, :d] = arm
    ij[:, :d, d] = -arm
    ji[:] = np.swapaxes(ij, 1, 2)
    return blocks


def certify(problem: Problem, rotations: Floats, translations: Floats, cost: float) -> Certificate:
    """The certificate of the poses in the problem's order, where its components are pinned by one vertex each."""
    d, free = problem.dimension, problem.free_count
    scale = float(np.median(problem.kappa)) if len(problem.kappa) else 1.0
    rank = d * problem.count
    matrix = certificate_matrix(problem, rotations, translations)
    kept = np.ones((problem.count, d + 1), bool)
    kept[free:, d] = False
    rows = np.flatnonzero(kept.reshape(-1))
    ones = np.zeros((problem.count, d + 1))
    ones[:, :d] = 1.0
    negative = -1
    for relative in RELATIVE_SHIFTS:
        shift = max(relative * scale, RELATIVE_GAP * cost / rank)
        shifted = csc_matrix(matrix + diags_array(shift * ones.reshape(-1)))
        negative = negative_pivots(csc_matrix(shifted[rows][:, rows]))
        if negative == 0:
            bound = shift * rank
            note = f"globally optimal: F = {cost:.9g} is within {bound:.3g} of the least (certified)"
            return Certificate(True, shift, bound, 0, note)
    found = "the factorisation broke down" if negative < 0 else f"{negative} negative eigenvalues"
    return Certificate(False, shift, np.inf, negative, f"not certified as the global minimum: {found}")
