"""Sparse direct solves of symmetric positive definite systems: the one place that knows which library does it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.sparse import bsr_matrix, csc_matrix, csr_matrix
from scipy.sparse.linalg import SuperLU, splu

from hodge_pipeline.errors import GraphError
from hodge_pipeline.solvers.block_factor import by_columns, eliminate_blocks, unpacked
from hodge_pipeline.solvers.elimination import Elimination, Ordering
from hodge_pipeline.types import Floats

MINIMUM_DEGREE_TO = 300_000
"""Above this many vertices SuperLU's minimum degree costs more than the fill that it saves on chain-like graphs."""
CHAIN_EDGES_PER_VERTEX = 1.5
"""A graph of fewer is chain-like: hardly anything fills up, whatever the order of elimination."""
SUPERLU_SIZES = {"relax": 1, "panel_size": 4}
"""No merging of small supernodes, narrow panels: on graphs' matrices a factorisation then takes 0.5 to 0.9 of the time
that it takes with SuperLU's own sizes (10 and 20). Larger ones than those overrun its work space."""


@dataclass(frozen=True)
class Factor:
    """A factorised matrix of `size` rows, to be solved with as often as needed."""

    size: int
    solve_columns: Callable[[Floats], Floats]

    def solve(self, rhs: Floats) -> Floats:
        """The solution (n,) or (n, k) of `matrix @ x = rhs`."""
        if self.size == 0:
            return np.zeros_like(rhs, dtype=float)
        return np.asarray(self.solve_columns(np.asarray(rhs, float)))


def factorise(matrix: csc_matrix | csr_matrix, ordering: str = "auto") -> Factor:
    """The factor of a symmetric positive definite matrix (n, n).

    `ordering` is a column permutation of SuperLU (`MMD_AT_PLUS_A`, `COLAMD`, `NATURAL`); `auto` is minimum degree on
    A + Aᵀ, which keeps the fill of most graph Laplacians lowest. Raises `GraphError` where the matrix is singular.
    """
    csc = csc_matrix(matrix, dtype=np.float64, copy=False)
    size = int(csc.shape[0])
    if size == 0:
        return Factor(0, lambda rhs: rhs)
    return Factor(size, _decompose(csc, "MMD_AT_PLUS_A" if ordering == "auto" else ordering).solve)


def factorise_blocks(plan: Elimination, matrix: bsr_matrix) -> Factor:
    """The factor of a symmetric positive definite block matrix (n · s, n · s) whose rows are in the plan's order.

    Raises `GraphError` where the matrix is singular.
    """
    if not plan.groups:
        return factorise(by_columns(matrix), "NATURAL")
    try:
        found = eliminate_blocks(plan, *unpacked(plan, matrix), lambda left: factorise(left, "NATURAL").solve)
    except np.linalg.LinAlgError as error:
        raise GraphError(_singular(matrix.shape[0])) from error
    return Factor(int(matrix.shape[0]), found.solve)


def fill_reducing_order(laplacian: csc_matrix | csr_matrix) -> Ordering:
    """The order of elimination of a positive definite graph Laplacian's rows, and what it costs.

    Block matrices on the same graph, in this order, are then factorised with `NATURAL`: minimum degree is run once,
    on the scalar graph, and never on the 3n or 6n unknowns.
    """
    csc = csc_matrix(laplacian, dtype=float)
    size = int(csc.shape[0])
    if size < 3:
        return Ordering(np.arange(size, dtype=np.int64), float(size**3), float(size**2))
    chain_like = csc.nnz - size < 2 * CHAIN_EDGES_PER_VERTEX * size
    ordering = "COLAMD" if size > MINIMUM_DEGREE_TO and chain_like else "MMD_AT_PLUS_A"
    factor = _decompose(csc, ordering)
    columns = np.diff(factor.L.indptr).astype(float)
    return Ordering(np.argsort(factor.perm_c).astype(np.int64), float(columns @ columns), float(columns.sum()))


def negative_pivots(matrix: csc_matrix) -> int:
    """How many negative eigenvalues a symmetric matrix (n, n) has, by Sylvester's law of inertia; −1 where it is
    singular to working precision, so that there is no telling.

    The rows must be in elimination order already.
    """
    if matrix.shape[0] == 0:
        return 0
    factor = _symmetric(matrix)
    return -1 if factor is None else int((factor.U.diagonal() < 0).sum())


def definite_factor(matrix: csc_matrix) -> Factor | None:
    """The factor of a symmetric matrix (n, n) whose rows are in elimination order; None unless it is definite."""
    factor = _symmetric(matrix)
    if factor is None or (factor.U.diagonal() < 0).any():
        return None
    return Factor(int(matrix.shape[0]), factor.solve)


def _symmetric(matrix: csc_matrix) -> SuperLU | None:
    """L D Lᵀ of a symmetric matrix; None where it is singular to working precision."""
    try:
        factor = _decompose(matrix, "NATURAL")
    except GraphError:
        return None
    return factor if np.array_equal(factor.perm_r, factor.perm_c) else None


def _decompose(csc: csc_matrix, ordering: str) -> SuperLU:
    try:
        return splu(csc, permc_spec=ordering, diag_pivot_thresh=0.0, options={"SymmetricMode": True}, **SUPERLU_SIZES)
    except RuntimeError as error:
        raise GraphError(_singular(csc.shape[0])) from error


def _singular(size: int) -> str:
    return (
        f"the edges do not determine all {size} unknowns (a singular linear system): some have information that is "
        "zero or almost zero on an axis: state some on each, or leave these edges out"
    )
