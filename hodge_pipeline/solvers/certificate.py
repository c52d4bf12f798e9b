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

RELATIVE_SHIFT = 1e-5
"""ε over κ's scale: far above rounding, far below the negative eigenvalues of local minima."""
RELATIVE_GAP = 1e-4
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
    kappa, tau = problem.kappa[:, None, None], problem.tau[:, None, None]
    blocks = np.zeros((4, len(problem.tau), size, size))
    ii, jj, ij, ji = blocks
    ii[:, :d, :d] = kappa * np.eye(d) + tau * (problem.translations[:, :, None] * problem.translations[:, None, :])
    jj[:, :d, :d] = kappa * np.eye(d)
    ij[:, :d, :d] = -kappa * problem.rotations
    ii[:, d, d] = jj[:, d, d] = problem.tau
    ij[:, d, d] = -problem.tau
    lever = problem.tau[:, None] * problem.translations
    ii[:, :d, d] = ii[:, d, :d] = lever
    ij[:, :d, d] = -lever
    ji[:] = np.swapaxes(ij, 1, 2)
    rows = np.concatenate([problem.tail, problem.head, problem.tail, problem.head])
    columns = np.concatenate([problem.tail, problem.head, problem.head, problem.tail])
    matrix = BlockPattern.of(rows, columns, (count, count)).assemble(blocks.reshape(-1, size, size))
    stacked = np.concatenate([np.swapaxes(rotations, 1, 2), translations[:, None, :]], axis=1)
    image = (matrix @ stacked.reshape(-1, d)).reshape(count, size, d)
    multiplier = image[:, :d] @ rotations
    diagonal = np.zeros((count, size, size))
    diagonal[:, :d, :d] = 0.5 * (multiplier + np.swapaxes(multiplier, 1, 2))
    vertices = np.arange(count + 1, dtype=np.int32)
    return (matrix - bsr_matrix((diagonal, vertices[:-1], vertices), shape=matrix.shape)).tobsr((size, size))


def certify(problem: Problem, rotations: Floats, translations: Floats, cost: float) -> Certificate:
    """The certificate of the poses in the problem's order, where its components are pinned by one vertex each."""
    d, free = problem.dimension, problem.free_count
    scale = float(np.median(problem.kappa)) if len(problem.kappa) else 1.0
    rank = d * problem.count
    shift = max(RELATIVE_SHIFT * scale, RELATIVE_GAP * cost / rank)
    matrix = certificate_matrix(problem, rotations, translations)
    kept = np.ones((problem.count, d + 1), bool)
    kept[free:, d] = False
    rows = np.flatnonzero(kept.reshape(-1))
    shifts = np.zeros((problem.count, d + 1))
    shifts[:, :d] = shift
    shifted = csc_matrix(matrix + diags_array(shifts.reshape(-1)))[rows][:, rows]
    negative = negative_pivots(csc_matrix(shifted))
    if negative == 0:
        note = f"globally optimal to within {shift * rank:.3g} of F = {cost:.6g} (certified)"
        return Certificate(True, shift, shift * rank, 0, note)
    found = "its factorisation broke down" if negative < 0 else f"{negative} negative eigenvalues"
    return Certificate(False, shift, np.inf, negative, f"not certified as the global minimum: {found}")
