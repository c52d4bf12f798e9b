"""The coboundary operators of Eq. (1) as sparse matrices, and the Laplacian that they make."""

from __future__ import annotations

import numpy as np
from scipy.sparse import csc_matrix, csr_matrix, diags

from hodge_pipeline.errors import GraphError
from hodge_pipeline.types import Bools, Floats, Ints


def coboundary_0(edges: Ints, vertex_count: int) -> csr_matrix:
    """d0 (E, V) of Eq. (1): `(d0 f)_ij = f_j − f_i`, one row for each edge (i, j) in the direction given.

    Parallel edges have a row each; the row of a self-loop is empty. Raises `GraphError` where an edge names a vertex
    that is not there.
    """
    edges = np.asarray(edges, np.int64).reshape(-1, 2)
    check_edges(edges, vertex_count)
    count = len(edges)
    proper = (edges[:, 0] != edges[:, 1]).astype(float)
    rows = np.repeat(np.arange(count), 2)
    values = np.stack([-proper, proper], axis=1).ravel()
    matrix = csr_matrix((values, (rows, edges.ravel())), shape=(count, vertex_count))
    matrix.eliminate_zeros()
    return matrix


def check_edges(edges: Ints, vertex_count: int) -> None:
    """Raises `GraphError` where an edge names a vertex row outside 0 … V − 1."""
    outside = (edges < 0) | (edges >= vertex_count)
    if outside.any():
        row = int(np.flatnonzero(outside.any(axis=1))[0])
        i, j = edges[row]
        raise GraphError(f"edge {row} joins vertex rows {i} and {j}, but the graph has {vertex_count} vertices")


def grounded_laplacian(d0: csr_matrix, weights: Floats, grounded: Bools) -> csc_matrix:
    """L = d0ᵀ W d0 without the rows and columns of the grounded vertices (V,): positive definite where each connected
    component of the edges with positive weight has a grounded vertex (Eqs. (7) and (8)).
    """
    laplacian = csr_matrix(d0.T @ diags(weights) @ d0)
    free = np.flatnonzero(~grounded)
    return csc_matrix(laplacian[free][:, free])
