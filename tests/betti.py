"""Betti numbers by exact ranks: how many pieces, unfilled loops and voids a complex has (paper, Section 3.1)."""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_matrix

from hodge_pipeline.complex.cech import SimplicialComplex
from hodge_pipeline.complex.components import connected_components

PRIME = 2_147_483_647  # the rank over this field is that over the rationals unless it divides a torsion coefficient


def betti_numbers(complex_: SimplicialComplex) -> tuple[int, int]:
    """b_0 and b_1 of a complex: how many pieces and how many loops that nothing fills.

    `b_1 = N_1 − rank d_1 − rank d_0`, by exact elimination over a prime field: for up to some 1e5 simplices.
    """
    vertices, edges, _ = complex_.counts
    pieces = int(connected_components(complex_.simplices[1], vertices).max(initial=-1)) + 1
    most = edges - (vertices - pieces)
    return pieces, most - sparse_rank(complex_.coboundary(1), stop_at=most)


def sparse_rank(matrix: csr_matrix, stop_at: int | None = None) -> int:
    """The exact rank of a sparse integer matrix over a large prime field; ends early once it reaches `stop_at`.

    Every row is reduced by the earlier ones with its own last column as pivot, as in persistent homology.
    """
    rows = csr_matrix(matrix)
    rows.sum_duplicates()
    reduced: dict[int, dict[int, int]] = {}
    limit = min(rows.shape) if stop_at is None else stop_at
    for start, stop in zip(rows.indptr[:-1], rows.indptr[1:], strict=True):
        if len(reduced) >= limit:
            break
        columns, values = rows.indices[start:stop].tolist(), np.asarray(rows.data[start:stop], np.int64).tolist()
        entry = {c: v % PRIME for c, v in zip(columns, values, strict=True) if v % PRIME}
        _reduce_into(entry, reduced)
    return len(reduced)


def _reduce_into(entry: dict[int, int], reduced: dict[int, dict[int, int]]) -> None:
    while entry:
        pivot = max(entry)
        other = reduced.get(pivot)
        if other is None:
            inverse = pow(entry[pivot], -1, PRIME)
            reduced[pivot] = {c: v * inverse % PRIME for c, v in entry.items()}
            return
        factor = entry[pivot]
        for column, value in other.items():
            left = (entry.get(column, 0) - factor * value) % PRIME
            if left:
                entry[column] = left
            else:
                entry.pop(column, None)
