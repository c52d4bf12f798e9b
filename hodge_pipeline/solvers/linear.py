"""Sparse direct solves of symmetric positive definite systems: the one place that knows which library does it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.sparse import csc_matrix, csr_matrix
from scipy.sparse.linalg import splu

from hodge_pipeline.errors import GraphError
from hodge_pipeline.types import Floats


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
    A + Aᵀ, which keeps the fill of most graph Laplacians lowest. Raises `GraphError` where the matrix
    is singular.
    """
    csc = csc_matrix(matrix, dtype=float)
    size = int(csc.shape[0])
    if size == 0:
        return Factor(0, lambda rhs: rhs)
    permutation = "MMD_AT_PLUS_A" if ordering == "auto" else ordering
    try:
        factor = splu(csc, permc_spec=permutation, diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    except RuntimeError as error:
        message = f"a linear system of {size} unknowns is singular: check for zero weights and unpinned components"
        raise GraphError(message) from error
    return Factor(size, factor.solve)
