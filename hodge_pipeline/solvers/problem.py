"""A pose graph in the order and the form in which the maximum-likelihood solver works on it.

Vertices are in elimination order, the pinned ones last; rotations are d x d and tangent vectors have p = d (d − 1) / 2
components, so that a planar graph is solved as one.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import bsr_matrix, csc_matrix, csr_matrix

from hodge_pipeline.solvers.linear import Factor, factorise, fill_reducing_order
from hodge_pipeline.types import Bools, Floats, Ints

SAME_RATIO = 1e-13


@dataclass(frozen=True)
class BlockPattern:
    """The structure of a block-sparse matrix that is a sum of contributions: made once, for many data.

    `scatter (blocks, contributions)` sums the contributions into blocks; `indptr`, `indices` are the BSR structure.
    """

    scatter: csr_matrix
    indptr: NDArray[np.int32]
    indices: NDArray[np.int32]
    shape: tuple[int, int]

    @classmethod
    def of(cls, rows: Ints, columns: Ints, shape: tuple[int, int]) -> BlockPattern:
        """The pattern of contributions to these block rows and columns; those outside the shape are left out."""
        kept = np.flatnonzero((rows < shape[0]) & (columns < shape[1]))
        keys = rows[kept] * shape[1] + columns[kept]
        unique, inverse = np.unique(keys, return_inverse=True)
        entries = (np.ones(len(kept)), (inverse.reshape(-1), kept))
        scatter = csr_matrix(entries, shape=(len(unique), len(rows)))
        indptr = np.searchsorted(unique, np.arange(shape[0] + 1) * shape[1]).astype(np.int32)
        return cls(scatter, indptr, (unique % max(shape[1], 1)).astype(np.int32), shape)

    def assemble(self, contributions: Floats) -> bsr_matrix:
        """The matrix with these blocks (contributions, r, c)."""
        count, rows, columns = contributions.shape
        data = (self.scatter @ contributions.reshape(count, rows * columns)).reshape(-1, rows, columns)
        shape = (self.shape[0] * rows, self.shape[1] * columns)
        return bsr_matrix((data, self.indices, self.indptr), shape=shape)


@dataclass(frozen=True)
class Problem:
    """Edges, weights and the pinned vertices of one pose graph.

    - `order (n,)`: the graph's vertex at each position; the first `free_count` positions are unknown.
    - `tail`, `head (E,)`: positions of i and j; `rotations (E, d, d)`, `translations (E, d)`: i_from_j.
    - `kappa`, `tau (E,)`: positive weights of the isotropic objective (SE-Sync, equation 11).
    """

    order: Ints
    free_count: int
    tail: Ints
    head: Ints
    rotations: Floats
    translations: Floats
    kappa: Floats
    tau: Floats

    @property
    def dimension(self) -> int:
        """2 or 3."""
        return int(self.rotations.shape[-1])

    @property
    def tangent_size(self) -> int:
        """Components of a rotation's tangent vector, 1 or 3."""
        return 1 if self.dimension == 2 else 3

    @property
    def count(self) -> int:
        """Vertices, pinned ones included."""
        return len(self.order)

    @cached_property
    def at_tail(self) -> csr_matrix:
        """The matrix (n, E) that sums edge values at the vertex i of each."""
        return _indicator(self.tail, self.count)

    @cached_property
    def at_head(self) -> csr_matrix:
        """The matrix (n, E) that sums edge values at the vertex j of each."""
        return _indicator(self.head, self.count)

    @cached_property
    def rotation_factor(self) -> Factor:
        """The scalar Laplacian of κ, factorised once."""
        return factorise(laplacian(self.tail, self.head, self.kappa, self.free_count), "NATURAL")

    @cached_property
    def translation_factor(self) -> Factor:
        """The scalar Laplacian of τ, factorised once: that of κ, where every edge has the same ratio of the two."""
        ratio = self.tau / self.kappa
        if len(ratio) and np.ptp(ratio) <= SAME_RATIO * ratio[0]:
            solve, scale = self.rotation_factor.solve, 1 / ratio[0]
            return Factor(self.free_count, lambda rhs: scale * solve(rhs))
        return factorise(laplacian(self.tail, self.head, self.tau, self.free_count), "NATURAL")

    @cached_property
    def symmetric_pattern(self) -> BlockPattern:
        """Of a matrix over the free vertices, contributions in the order ii, jj, ij, ji."""
        rows = np.concatenate([self.tail, self.head, self.tail, self.head])
        columns = np.concatenate([self.tail, self.head, self.head, self.tail])
        return BlockPattern.of(rows, columns, (self.free_count, self.free_count))

    @cached_property
    def coupling_pattern(self) -> BlockPattern:
        """Of a matrix from the vertex i of each edge to its residual's two ends, contributions in the order ji, ii."""
        rows, columns = np.concatenate([self.head, self.tail]), np.concatenate([self.tail, self.tail])
        return BlockPattern.of(rows, columns, (self.free_count, self.free_count))


def _indicator(vertices: Ints, count: int) -> csr_matrix:
    edges = len(vertices)
    return csr_matrix((np.ones(edges), (vertices, np.arange(edges))), shape=(count, edges))


def laplacian(tail: Ints, head: Ints, weights: Floats, free_count: int) -> csc_matrix:
    """The weighted graph Laplacian of the first `free_count` vertices, the others pinned."""
    rows = np.concatenate([tail, head, tail, head])
    columns = np.concatenate([tail, head, head, tail])
    values = np.concatenate([weights, weights, -weights, -weights])
    kept = (rows < free_count) & (columns < free_count)
    return csc_matrix((values[kept], (rows[kept], columns[kept])), shape=(free_count, free_count))


def make_problem(
    edges: Ints, rotations: Floats, translations: Floats, kappa: Floats, tau: Floats, pinned: Bools
) -> Problem:
    """The problem with its vertices in elimination order. `pinned (V,)` must hold one vertex or more of each
    component; edges must not join a vertex to itself.
    """
    free, rest = np.flatnonzero(~pinned), np.flatnonzero(pinned)
    position = np.empty(len(pinned), np.int64)
    position[free], position[rest] = np.arange(len(free)), len(free) + np.arange(len(rest))
    tail, head = position[edges[:, 0]], position[edges[:, 1]]
    elimination = fill_reducing_order(laplacian(tail, head, np.ones(len(edges)), len(free)))
    order = np.concatenate([free[elimination], rest])
    position[order] = np.arange(len(order))
    return Problem(order, len(free), position[edges[:, 0]], position[edges[:, 1]], rotations, translations, kappa, tau)


def pinned_vertices(component: Ints, fixed: Ints) -> Bools:
    """The fixed vertices, and the first vertex of every component that has none."""
    pinned = np.zeros(len(component), bool)
    pinned[fixed] = True
    held = np.zeros(component.max(initial=-1) + 1, bool)
    held[component[pinned]] = True
    names, first = np.unique(component, return_index=True)
    pinned[first[~held[names]]] = True
    return pinned
