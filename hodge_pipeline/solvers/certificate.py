"""Whether a minimum of the isotropic objective is the global one: the dual certificate of SE-Sync (theorem 7).

At a critical point, Q − Λ ⪰ 0 proves it. Q − Λ is factorised together with the translations that Q eliminates, so the
matrix stays as sparse as the graph; by Sylvester's law its negative pivots are its negative eigenvalues.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import bsr_matrix, csc_matrix, diags_array
from scipy.sparse.linalg import ArpackError, LinearOperator, eigsh

from hodge_pipeline.errors import GraphError
from hodge_pipeline.solvers.linear import Factor, definite_factor, negative_pivots
from hodge_pipeline.solvers.problem import BlockPattern, Problem
from hodge_pipeline.types import Floats, Ints

RELATIVE_SHIFTS = (1e-10, 1e-7)
"""ε over κ's scale, the second where the first is lost in rounding; local minima have eigenvalues far below both."""
RELATIVE_GAP = 1e-6
"""ε is taken larger where even then the bound on the gap stays below this share of F."""
BRACKET = 8.0
"""The factor between the shifts that are tried until a matrix is definite."""
MAX_BRACKETS = 40
"""Shifts that are tried: they reach 10³⁶ times the first."""
GAP_STEP = 4.0
"""The factor between the gaps that are tried for a bound: each costs a factorisation."""
EIGENVALUE_TOLERANCE = 1e-3
"""Relative: the eigenvector is a direction to descend along, the eigenvalue a first guess of the gap."""
ABOVE = 1.01
"""The first gap that is tried, relative to the one from the smallest eigenvalue."""
FIRST_SHIFT = 1e-3
"""Over κ's scale: that of an inverse to precondition with; the smaller, the fewer steps, the more factorisations."""


@dataclass(frozen=True)
class Certificate:
    """The answer: `optimal`, with every eigenvalue of Q − Λ ≥ −shift and `gap_bound` ≥ F − F_optimal when it is.

    When it is not, `smallest_eigenvalue` is that of Q − Λ, NaN where it was not found, and `direction (n, d)` its
    eigenvector: where F falls once the rotations may turn into another dimension.
    """

    optimal: bool
    shift: float
    gap_bound: float
    note: str
    smallest_eigenvalue: float = 0.0
    direction: Floats | None = None


def connection_matrix(problem: Problem) -> bsr_matrix:
    """M on (rotation rows, translation) of each vertex, in the problem's order: F = tr(Xᵀ M X) (equation 15)."""
    count, size = problem.count, problem.dimension + 1
    rows = np.stack([problem.tail, problem.head, problem.tail, problem.head])
    columns = np.stack([problem.tail, problem.head, problem.head, problem.tail])
    pattern = BlockPattern.of(rows, columns, (count, count))
    return pattern.assemble(lambda edges: _blocks(problem, edges), (size, size))


def certificate_matrix(problem: Problem, rotations: Floats, translations: Floats) -> bsr_matrix:
    """[[M − Λ, Vᵀ], [V, L_τ]] on (rotation rows, translation) of each vertex, in the problem's order.

    Its Schur complement over the translations is Q − Λ (SE-Sync, equations 15 and 23). The rotations (n, r, d) and
    translations (n, r) may be those of a space of r ≥ d dimensions.
    """
    d, count, r = problem.dimension, problem.count, translations.shape[1]
    size = d + 1
    matrix = connection_matrix(problem)
    stacked = np.concatenate([np.swapaxes(rotations, 1, 2), translations[:, None, :]], axis=1)
    image = (matrix @ stacked.reshape(-1, r)).reshape(count, size, r)
    multiplier = image[:, :d] @ rotations
    return _less(matrix, 0.5 * (multiplier + np.swapaxes(multiplier, 1, 2)))


def _less(matrix: bsr_matrix, multiplier: Floats) -> bsr_matrix:
    """M − Λ, of the multiplier's blocks (n, d, d) on the rotation rows."""
    (count, d, _), size = multiplier.shape, matrix.blocksize[0]
    diagonal = np.zeros((count, size, size))
    diagonal[:, :d, :d] = multiplier
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
    """The certificate of a critical point: rotations (n, d, d) and translations (n, d) in the problem's order, where
    its components are pinned by one vertex each, and their F, `cost`.
    """
    d = problem.dimension
    scale = _scale(problem)
    rank = d * problem.count
    matrix, on_rotations = _reduced(problem, certificate_matrix(problem, rotations, translations))
    negative = -1
    for relative in RELATIVE_SHIFTS:
        shift = max(relative * scale, RELATIVE_GAP * cost / rank)
        negative = negative_pivots(_shifted(matrix, shift, on_rotations))
        if negative == 0:
            bound = shift * rank
            note = f"globally optimal: F = {cost:.9g} is within {bound:.3g} of the least (certified)"
            return Certificate(True, shift, bound, note)
    if negative < 0:
        note = "not certified as the global minimum: the factorisation broke down"
        return Certificate(False, shift, np.inf, note)
    smallest, vector = _smallest_eigenvalue(matrix, shift, on_rotations)
    direction = None
    if vector is not None:
        direction = vector.reshape(problem.count, d)
    note = f"not certified as the global minimum: {negative} negative eigenvalues, the smallest {smallest:.6g}"
    return Certificate(False, shift, np.inf, note, smallest, direction)


def _scale(problem: Problem) -> float:
    """The median κ, 1 without edges: what shifts are relative to."""
    return float(np.median(problem.kappa)) if len(problem.kappa) else 1.0


def lower_bound(
    problem: Problem, rotations: Floats, translations: Floats, cost: float, smallest_eigenvalue: float
) -> float:
    """What F is at least, whatever the rotations: from a point (n, r, d), (n, r) of a higher space that costs `cost`.

    `smallest_eigenvalue`: about that of Q − Λ there, NaN where it was not computed.
    For all R, F(R) ≥ tr Λ + λ_min(Q − Λ) · n d, and tr Λ is the cost. −∞ where there is no finite bound.
    """
    matrix, on_rotations = _reduced(problem, certificate_matrix(problem, rotations, translations))
    rank = problem.dimension * problem.count
    least = RELATIVE_GAP / GAP_STEP * cost
    gap = max(least, ABOVE * -smallest_eigenvalue * rank) if math.isfinite(smallest_eigenvalue) else least
    while gap < cost:
        shift = gap / rank
        if negative_pivots(_shifted(matrix, shift, on_rotations)) == 0:
            return cost - gap
        gap *= GAP_STEP
    return -math.inf


def bounded(answer: Certificate, cost: float, bound: float) -> Certificate:
    """The answer for poses that cost so much where F is at least the bound: optimal, if the two are close enough."""
    gap = max(cost - bound, 0.0)
    if not math.isfinite(gap) or gap >= answer.gap_bound:
        return answer
    if gap <= RELATIVE_GAP * cost:
        note = f"globally optimal: F = {cost:.9g} is within {gap:.3g} of the least (certified)"
        return replace(answer, optimal=True, gap_bound=gap, note=note)
    note = f"{answer.note}; no poses have an F lower by more than {gap:.3g} ({gap / cost:.1g} of it)"
    return replace(answer, gap_bound=gap, note=note)


def definite_inverse(problem: Problem, connection: bsr_matrix, multiplier: Floats) -> Callable[[Floats], Floats]:
    """The inverse of Q − Λ + s · I on vectors (n, d, r), s such that it is definite; its translations are eliminated.

    `connection` is M, `multiplier (n, d, d)` Λ.
    """
    d, rows = problem.dimension, _rows(problem)
    matrix, on_rotations = _reduced(problem, _less(connection, multiplier))
    factor, _ = _definite(matrix, FIRST_SHIFT * _scale(problem), on_rotations)

    def apply(vectors: Floats) -> Floats:
        stacked = np.zeros((problem.count, d + 1, vectors.shape[2]))
        stacked[:, :d] = vectors
        flat = stacked.reshape(-1, vectors.shape[2])
        flat[rows] = factor.solve(flat[rows])
        return flat.reshape(stacked.shape)[:, :d]

    return apply


def _definite(matrix: csc_matrix, shift: float, on_rotations: Floats) -> tuple[Factor, float]:
    """The factor of the first matrix that is definite as the shift grows, and that shift.

    Raises `GraphError` where none is.
    """
    for _ in range(MAX_BRACKETS):
        factor = definite_factor(_shifted(matrix, shift, on_rotations))
        if factor is not None:
            return factor, shift
        shift *= BRACKET
    raise GraphError(f"a linear system of {matrix.shape[0]} unknowns stays indefinite: check for contradictory weights")


def _reduced(problem: Problem, matrix: bsr_matrix) -> tuple[csc_matrix, Floats]:
    """The matrix without pinned translations, and 1 at the rows of rotations."""
    rows, size = _rows(problem), problem.dimension + 1
    return csc_matrix(csc_matrix(matrix)[rows][:, rows]), (rows % size < size - 1).astype(float)


def _rows(problem: Problem) -> Ints:
    """The rows of M, in the order of elimination, without pinned translations."""
    size = problem.dimension + 1
    rows = np.arange(problem.count * size)
    return rows[(rows % size < size - 1) | (rows < problem.free_count * size)]


def _shifted(matrix: csc_matrix, shift: float, on_rotations: Floats) -> csc_matrix:
    """The matrix whose Schur complement over the translations is Q − Λ + shift · I."""
    return csc_matrix(matrix + diags_array(shift * on_rotations))


def _smallest_eigenvalue(matrix: csc_matrix, shift: float, on_rotations: Floats) -> tuple[float, Floats | None]:
    """The smallest eigenvalue of the Schur complement Q − Λ, below −shift, and its vector on the rows of rotations.

    By Lanczos on the inverse of Q − Λ + s · I for the first s in a geometric row that makes it definite, so that the
    wanted eigenvalue lies apart from all others. NaN and None where that does not settle.
    """
    factor, shift = _definite(matrix, BRACKET * shift, on_rotations)
    rows = np.flatnonzero(on_rotations)

    def inverse(vector: Floats) -> Floats:
        rhs = np.zeros(len(on_rotations))
        rhs[rows] = vector.reshape(-1)
        return factor.solve(rhs)[rows]

    operator = LinearOperator((len(rows), len(rows)), matvec=inverse, dtype=float)
    begin = np.random.default_rng(0).normal(size=len(rows))
    try:
        values, vectors = eigsh(operator, k=1, which="LA", v0=begin, tol=EIGENVALUE_TOLERANCE)
    except ArpackError:
        return math.nan, None
    return float(1 / values[0] - shift), vectors[:, 0]
