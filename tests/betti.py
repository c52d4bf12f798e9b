"""Betti numbers by exact ranks: how many pieces, unfilled loops and voids a complex has (paper, Section 3.1)."""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_matrix

from hodge_pipeline.complex.cech import SimplicialComplex
from hodge_pipeline.complex.components import connected_components

PRIME = 2_147_483_647  # the rank over this field is that over the rationals unless it divides a torsion coefficient


def betti_numbers(complex_: SimplicialComplex) -> tuple[int, ...]:
    """b_0 … b_{n−1} of a complex listed up to dimension n; b_n would need the simplices above it.

    `b_k = N_k − rank d_k − rank d_{k−1}`, by exact elimination over a prime field: for up to some 1e5 simplices.
    """
    counts = complex_.counts
    pieces = int(connected_components(complex_.simplices[1], complex_.vertex_count).max(initial=-1)) + 1
    ranks = [counts[0] - pieces]
    for order in range(1, complex_.dimension):
        largest = counts[order] - ranks[-1]
        ranks.append(sparse_rank(complex_.coboundary(order), stop_at=largest))
    below = [0, *ranks]
    return tuple(counts[k] - ranks[k] - below[k] for k in range(complex_.dimension))


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
