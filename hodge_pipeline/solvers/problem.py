"""A pose graph in the order and the form in which the maximum-likelihood solver works on it.

Vertices are in elimination order, the pinned ones last; rotations are d x d and tangent vectors have p = d (d − 1) / 2
components, so that a planar graph is solved as one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import bsr_matrix, csc_matrix, csr_matrix

from hodge_pipeline.solvers.backends import choose, laplacian_factor
from hodge_pipeline.solvers.elimination import Elimination
from hodge_pipeline.solvers.iterative import IterativeSolver
from hodge_pipeline.solvers.linear import Factor
from hodge_pipeline.solvers.multigrid import Preconditioning
from hodge_pipeline.solvers.rotations import exponential
from hodge_pipeline.types import Bools, Floats, Ints

SAME_RATIO = 1e-13
"""Relative: some hundred roundings, as a product of stated numbers may have."""

CHUNK = 1 << 12
"""Edges whose blocks are made at a time: they stay in the cache, and memory never holds those of all edges."""


@dataclass(frozen=True)
class _Piece:
    """A chunk of edges: the blocks that they contribute to, and the matrix that sums their contributions into those.

    Contributions `sole` are the only ones to the blocks `places`.
    """

    edges: slice
    targets: Ints
    scatter: csr_matrix
    places: Ints
    sole: Ints


@dataclass(frozen=True)
class BlockPattern:
    """The structure of a block-sparse matrix that is a sum of contributions of edges: made once, for many data.

    `indptr`, `indices` are the BSR structure.
    """

    pieces: tuple[_Piece, ...]
    indptr: NDArray[np.int32]
    indices: NDArray[np.int32]
    shape: tuple[int, int]

    @classmethod
    def of(cls, rows: Ints, columns: Ints, shape: tuple[int, int]) -> BlockPattern:
        """The pattern where edge e contributes to the block rows (k, E) and columns (k, E); those outside the shape
        are left out.
        """
        keys = rows * shape[1] + columns
        keys[(rows >= shape[0]) | (columns >= shape[1])] = -1
        flat = np.sort(keys.reshape(-1))
        flat = flat[np.searchsorted(flat, 0) :]
        first = np.flatnonzero(np.diff(flat, prepend=-1))
        unique, single = flat[first], np.diff(first, append=len(flat)) == 1
        del flat, first
        pieces = []
        for begin in range(0, rows.shape[1], CHUNK):
            edges = slice(begin, min(begin + CHUNK, rows.shape[1]))
            part = keys[:, edges].reshape(-1)
            kept = np.flatnonzero(part >= 0)
            place = np.searchsorted(unique, part[kept])
            lone = single[place]
            found, inverse = np.unique(place[~lone], return_inverse=True)
            entries = (np.ones(len(inverse)), (inverse.reshape(-1), kept[~lone]))
            scatter = csr_matrix(entries, (len(found), len(part)))
            pieces.append(_Piece(edges, found, scatter, place[lone], kept[lone]))
        indptr = np.searchsorted(unique, np.arange(shape[0] + 1) * shape[1]).astype(np.int32)
        return cls(tuple(pieces), indptr, (unique % max(shape[1], 1)).astype(np.int32), shape)

    def assemble(self, blocks: Callable[[slice], Floats], size: tuple[int, int]) -> bsr_matrix:
        """The matrix with blocks of this size; `blocks(edges)` gives the contributions (k, m, r, c) of some edges."""
        rows, columns = size
        data = np.zeros((len(self.indices), rows * columns))
        for piece in self.pieces:
            parts = blocks(piece.edges).reshape(-1, rows * columns)
            data[piece.targets] += piece.scatter @ parts
            data[piece.places] = parts[piece.sole]
        shape = (self.shape[0] * rows, self.shape[1] * columns)
        return bsr_matrix((data.reshape(-1, rows, columns), self.indices, self.indptr), shape=shape)


@dataclass(frozen=True)
class Structure:
    """Which vertices the edges join: all that stays when measurements and weights change.

    - `order (n,)`: the graph's vertex at each position; the first `free_count` positions are unknown.
    - `tail`, `head (E,)`: positions of i and j.
    - `elimination`: of the free vertices, whose positions are its own; `precondition`: of linear
      systems on them, None where these are factorised.
    """

    order: Ints
    free_count: int
    tail: Ints
    head: Ints
    elimination: Elimination
    precondition: Preconditioning | None

    @cached_property
    def iterative(self) -> IterativeSolver | None:
        """The solver for steps of all unknowns, where the back end is iterative: its preconditioner serves one descent
        after another.
        """
        return None if self.precondition is None else IterativeSolver(self.precondition)

    @cached_property
    def at_tail(self) -> csc_matrix:
        """The matrix (n, E) that sums edge values at the vertex i of each."""
        return _indicator(self.tail, len(self.order))

    @cached_property
    def at_head(self) -> csc_matrix:
        """The matrix (n, E) that sums edge values at the vertex j of each."""
        return _indicator(self.head, len(self.order))

    @cached_property
    def symmetric_pattern(self) -> BlockPattern:
        """Of a matrix over the free vertices, contributions in the order ii, jj, ij, ji."""
        rows = np.stack([self.tail, self.head, self.tail, self.head])
        columns = np.stack([self.tail, self.head, self.head, self.tail])
        return BlockPattern.of(rows, columns, (self.free_count, self.free_count))

    def laplacian(self, weights: Floats) -> csc_matrix:
        """The weighted graph Laplacian of the free vertices."""

        def entries(edges: slice) -> Floats:
            own = weights[edges]
            return np.stack([own, own, -own, -own])[..., None, None]

        found = self.symmetric_pattern.assemble(entries, (1, 1))
        return csc_matrix((found.data.reshape(-1), found.indices, found.indptr), found.shape)

    def factor(self, weights: Floats) -> Factor:
        """What solves with that Laplacian."""
        return laplacian_factor(self.laplacian(weights), self.precondition)

    @cached_property
    def coupling_pattern(self) -> BlockPattern:
        """Of a matrix from the vertex i of each edge to its residual's two ends, contributions in the order ji, ii."""
        rows, columns = np.stack([self.head, self.tail]), np.stack([self.tail, self.tail])
        return BlockPattern.of(rows, columns, (self.free_count, self.free_count))


@dataclass(frozen=True)
class Problem:
    """Edges and weights of one pose graph: `rotations (E, d, d)`, `translations (E, d)` of i_from_j, κ and τ (E,)."""

    structure: Structure
    rotations: Floats
    translations: Floats
    kappa: Floats
    tau: Floats

    @property
    def order(self) -> Ints:
        """The graph's vertex (n,) at each position."""
        return self.structure.order

    @property
    def free_count(self) -> int:
        """How many positions, the first ones, are unknown."""
        return self.structure.free_count

    @property
    def tail(self) -> Ints:
        """The position (E,) of the vertex i of each edge."""
        return self.structure.tail

    @property
    def head(self) -> Ints:
        """The position (E,) of the vertex j of each edge."""
        return self.structure.head

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
    def rotation_factor(self) -> Factor:
        """The scalar Laplacian of κ, factorised once."""
        return self.structure.factor(self.kappa)

    @cached_property
    def translation_factor(self) -> Factor:
        """The scalar Laplacian of τ, factorised once: that of κ, where every edge has the same ratio of the two."""
        counted = (self.tau > 0) | (self.kappa > 0)
        with np.errstate(divide="ignore"):  # a kappa of 0 has an infinite ratio, which no other is near
            ratio = self.tau[counted] / self.kappa[counted]
        if len(ratio) and np.isfinite(ratio).all() and np.ptp(ratio) <= SAME_RATIO * ratio[0]:
            solve, scale = self.rotation_factor.solve, 1 / ratio[0]
            return Factor(self.free_count, lambda rhs: scale * solve(rhs))
        return self.structure.factor(self.tau)

    def moved(self, rotations: Floats, translations: Floats, direction: Floats) -> tuple[Floats, Floats]:
        """Poses whose free ones are moved by a direction (free · (p + d),) in the world's axes."""
        free, p = self.free_count, self.tangent_size
        step = direction.reshape(free, p + self.dimension)
        turned, shifted = rotations.copy(), translations.copy()
        turned[:free] = exponential(step[:, :p]) @ rotations[:free]
        shifted[:free] += step[:, p:]
        return turned, shifted


def _indicator(vertices: Ints, count: int) -> csc_matrix:
    edges = len(vertices)
    return csc_matrix((np.ones(edges), vertices, np.arange(edges + 1)), shape=(count, edges))


def make_problem(
    edges: Ints,
    rotations: Floats,
    translations: Floats,
    kappa: Floats,
    tau: Floats,
    pinned: Bools,
    direct: bool = False,
) -> Problem:
    """The problem with its vertices in elimination order. `pinned (V,)` must hold one vertex or more of each
    component; edges must not join a vertex to itself. `direct`: a factorisation will be needed.
    """
    free, rest = np.flatnonzero(~pinned), np.flatnonzero(pinned)
    position = np.empty(len(pinned), np.int64)
    position[free], position[rest] = np.arange(len(free)), len(free) + np.arange(len(rest))
    tail, head = position[edges[:, 0]], position[edges[:, 1]]
    chosen, elimination = choose(tail, head, len(free), direct)
    order = np.concatenate([free[elimination.order], rest])
    position[order] = np.arange(len(order))
    structure = Structure(order, len(free), position[edges[:, 0]], position[edges[:, 1]], elimination, chosen)
    return Problem(structure, rotations, translations, kappa, tau)


def pinned_vertices(component: Ints, fixed: Ints) -> Bools:
    """The fixed vertices, and the first vertex of every component that has none."""
    pinned = np.zeros(len(component), bool)
    pinned[fixed] = True
    held = np.zeros(component.max(initial=-1) + 1, bool)
    held[component[pinned]] = True
    names, first = np.unique(component, return_index=True)
    pinned[first[~held[names]]] = True
    return pinned
