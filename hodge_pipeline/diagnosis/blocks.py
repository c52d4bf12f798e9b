"""Sets of views that hang together: the pieces, cut in two where fewest edges agree, again and again."""

from __future__ import annotations

import numpy as np

from hodge_pipeline.types import Floats, Ints

FAINT = 1e-9


def cut_blocks(edges: Ints, weight: Floats, piece: Ints) -> list[Ints]:
    """All blocks (rows of vertices), the largest first: pieces, their parts by normalised cuts, single views."""
    count = len(piece)
    matrix = np.zeros((count, count))
    np.add.at(matrix, (edges[:, 0], edges[:, 1]), weight + FAINT)
    matrix += matrix.T
    np.fill_diagonal(matrix, 0.0)
    found = {(vertex,) for vertex in range(count)}
    pending = [np.flatnonzero(piece == number) for number in range(int(piece.max(initial=-1)) + 1)]
    while pending:
        block = pending.pop()
        found.add(tuple(block.tolist()))
        if len(block) > 1:
            pending += _halves(block, matrix[np.ix_(block, block)])
    return [np.array(block, np.int64) for block in sorted(found, key=lambda block: (-len(block), block))]


def _halves(block: Ints, matrix: Floats) -> list[Ints]:
    """The best sweep cut along the second eigenvector of the normalised Laplacian (Shi and Malik 2000)."""
    degree = np.maximum(matrix.sum(axis=1), FAINT)
    scale = 1 / np.sqrt(degree)
    laplacian = np.eye(len(block)) - scale[:, None] * matrix * scale[None]
    order = np.argsort(np.linalg.eigh(laplacian)[1][:, 1] * scale, kind="stable")
    sorted_matrix = matrix[np.ix_(order, order)]
    volume = np.cumsum(degree[order])[:-1]
    inner = 2 * np.cumsum(np.tril(sorted_matrix, -1).sum(axis=1))[:-1]
    across = (volume - inner) / np.minimum(volume, degree.sum() - volume)
    split = int(np.argmin(across)) + 1
    return [np.sort(block[order[:split]]), np.sort(block[order[split:]])]
