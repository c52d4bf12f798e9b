"""A preconditioner for graphs too large, or too tangled, to factorise: smoothed aggregation multigrid.

Vaněk, Mandel and Brezina 1996, with the motions of a rigid body in the place of elasticity's: a cluster of poses that
moves as one leaves the edges within it as they are, so that one coarse vertex can stand for it. Such modes are what the
scalar Laplacians miss, whose levers couple rotations to translations. Matrices are (n · s, n · s), of n vertices with
s unknowns each.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np
from scipy.sparse import bsr_matrix, csc_matrix, csr_matrix, diags_array

from hodge_pipeline.solvers.elimination import independent_set
from hodge_pipeline.solvers.linear import fill_reducing_order
from hodge_pipeline.solvers.rotations import lever
from hodge_pipeline.types import Floats, Ints

COARSEST = 300
"""Vertices that are factorised whatever their fill."""
ORDERED_TO, MOST_NEIGHBOURS_TRIED = 3000, 6
"""Vertices, and blocks in a row: a level with more of both fills up, and no order is looked for."""
FACTOR_WORTH = 5
"""Products of blocks for each block of the finest matrix that a level's factor may take: it saves levels, and steps."""
CHUNK, ROWS = 1 << 14, 1 << 11
"""Blocks, and block rows of a coarser matrix, that are taken at a time: their copies stay small."""
LEAST_COARSENING = 0.8
"""Of the vertices: a level that leaves more costs more than it saves."""
DAMPING = 4 / 3
"""Over the spectral radius of D⁻¹ A: the paper's, which damps the upper half of the spectrum most evenly."""
POWER_STEPS, SAFE_RADIUS = 10, 1.05
"""The power method's estimate is a lower bound of the spectral radius."""
CoarseSolver: TypeAlias = Callable[[csc_matrix], Callable[[Floats], Floats]]
"""matrix -> (r -> x): the exact solution of the coarsest level."""


@dataclass(frozen=True)
class Modes:
    """What leaves the edges as they are: motions of a rigid body about `positions (n, d)`, or a shift where None."""

    positions: Floats | None = None

    def blocks(self, count: int, size: int, centres: Floats | None = None) -> Floats:
        """The blocks (n, s, s) that take motions about the centres (n, d) to the vertices; about their mean if None."""
        blocks = np.zeros((count, size, size))
        blocks[:] = np.eye(size)
        if self.positions is not None:
            about = self.positions.mean(axis=0) if centres is None else centres
            d = self.positions.shape[1]
            blocks[:, size - d :, : size - d] = -lever(self.positions - about)
        return blocks

    def gathered(self, aggregate: Ints, count: int) -> Modes:
        """The modes of aggregates, about their centres."""
        if self.positions is None:
            return self
        members = np.bincount(aggregate, minlength=count)
        sums = [np.bincount(aggregate, column, count) for column in self.positions.T]
        return Modes(np.stack(sums, axis=1) / members[:, None])


Preconditioner: TypeAlias = Callable[[bsr_matrix, Floats], Floats]
"""(matrix, r) -> z: an approximate inverse, symmetric and positive definite, of a matrix near the one it is made of."""
Preconditioning: TypeAlias = Callable[[bsr_matrix, Modes], Preconditioner]
"""(matrix, modes) -> preconditioner."""


@dataclass(frozen=True)
class Level:
    """The inverse of a matrix's diagonal times the damping, and the way to the next coarser matrix and back."""

    damped: Floats
    prolong: bsr_matrix
    restrict: bsr_matrix
    coarser: bsr_matrix

    def relaxed(self, r: Floats) -> Floats:
        """A damped Jacobi step from zero."""
        blocks = r.reshape(len(self.damped), self.damped.shape[1], -1)
        return np.asarray(np.matmul(self.damped, blocks)).reshape(r.shape)


@dataclass(frozen=True)
class Multigrid:
    """One symmetric V-cycle, which is a positive definite approximation of the inverse."""

    levels: tuple[Level, ...]
    solve_coarsest: Callable[[Floats], Floats]

    def cycle(self, matrix: bsr_matrix, r: Floats, at: int = 0) -> Floats:
        """The approximate solution x of `matrix @ x = r`, (n · s,) or (n · s, k); the finest matrix may have changed a
        little, and is not kept.
        """
        if at == len(self.levels):
            return self.solve_coarsest(r)
        level = self.levels[at]
        x = level.relaxed(r)
        x += level.prolong @ self.cycle(level.coarser, level.restrict @ (r - matrix @ x), at + 1)
        x += level.relaxed(r - matrix @ x)
        return np.asarray(x)


@dataclass(frozen=True)
class Coarsening:
    """How the graphs of matrices are coarsened: found once for each pattern, for many matrices on it."""

    patterns: list[tuple[csr_matrix, Ints | None]] = field(default_factory=list)

    def of(self, matrix: bsr_matrix, finest: int) -> Ints | None:
        """The aggregate (n,) of each vertex; None where the matrix had better be factorised, `finest` being how many
        blocks the finest one has.
        """
        for pattern, found in self.patterns:
            if np.array_equal(pattern.indptr, matrix.indptr) and np.array_equal(pattern.indices, matrix.indices):
                return found
        aggregate = None if _worth_a_factor(matrix, finest) else aggregates(matrix)
        if aggregate is not None and aggregate.max() + 1 > LEAST_COARSENING * len(aggregate):
            aggregate = None
        self.patterns.append((_pattern(matrix), aggregate))
        return aggregate


def multigrid(matrix: bsr_matrix, modes: Modes, coarse: CoarseSolver, coarsening: Coarsening) -> Multigrid:
    """The hierarchy of a symmetric positive definite block matrix with these modes.

    `coarse` factorises the matrix of the last level.
    """
    levels, finest = [], len(matrix.indices)
    while (aggregate := coarsening.of(matrix, finest)) is not None:
        size, count = matrix.blocksize[0], int(aggregate.max()) + 1
        coarse_modes = modes.gathered(aggregate, count)
        about = None if coarse_modes.positions is None else coarse_modes.positions[aggregate]
        level = _level(matrix, modes.blocks(len(aggregate), size, about), aggregate, count)
        modes = coarse_modes
        levels.append(level)
        matrix = level.coarser
    return Multigrid(tuple(levels), coarse(matrix.tocsc()))


def _worth_a_factor(matrix: bsr_matrix, finest: int) -> bool:
    """Whether the matrix is small, or so like a tree that its factor fills up little."""
    count = len(matrix.indptr) - 1
    if count <= COARSEST:
        return True
    if count > ORDERED_TO and len(matrix.indices) > MOST_NEIGHBOURS_TRIED * count:
        return False
    pattern = _pattern(matrix)
    pattern.data[:] = -1.0
    definite = pattern + diags_array(np.diff(pattern.indptr) + 1.0)  # also where nothing is pinned
    return fill_reducing_order(definite).work < FACTOR_WORTH * finest


def _pattern(matrix: bsr_matrix) -> csr_matrix:
    """The matrix (n, n) of ones where a block is stored."""
    count = len(matrix.indptr) - 1
    return csr_matrix((np.ones(len(matrix.indices), np.float32), matrix.indices, matrix.indptr), shape=(count, count))


def _as_blocks(matrix: bsr_matrix, size: int) -> bsr_matrix:
    """The matrix in square blocks of this size, sorted within their rows."""
    out = matrix.tobsr((size, size))
    out.sort_indices()
    return out


def aggregates(matrix: bsr_matrix) -> Ints:
    """The aggregate (n,) of each vertex: seeds no two of which have a neighbour in common, and what is around each."""
    pattern = _pattern(matrix)
    count = pattern.shape[0]
    near = (pattern @ pattern).tocoo()
    once = near.row < near.col
    rank = np.random.default_rng(0).permutation(count)
    seeds = independent_set(near.row[once], near.col[once], np.ones(count, bool), rank)
    del near, once
    aggregate = np.full(count, -1)
    aggregate[seeds] = np.arange(int(seeds.sum()))
    rows = np.repeat(np.arange(count, dtype=np.int32), np.diff(pattern.indptr))
    while (left := aggregate < 0).any():
        joins = np.flatnonzero(left[rows] & ~left[pattern.indices])
        aggregate[rows[joins]] = aggregate[pattern.indices[joins]]
    return aggregate


def _level(matrix: bsr_matrix, blocks: Floats, aggregate: Ints, count: int) -> Level:
    """The level with prolongation (I − ω D⁻¹ A) P, where P (`blocks (n, s, s)`) moves each aggregate as one."""
    size, n = matrix.blocksize[0], len(aggregate)
    rows = np.repeat(np.arange(n, dtype=np.int32), np.diff(matrix.indptr))
    damped = np.linalg.inv(matrix.data[rows == matrix.indices])
    damped *= DAMPING / _spectral_radius(matrix, damped)
    rigid = bsr_matrix((blocks, aggregate, np.arange(n + 1)), shape=(n * size, count * size))
    prolong = _as_blocks(matrix @ rigid, size)
    owner = np.repeat(np.arange(n, dtype=np.int32), np.diff(prolong.indptr))
    for begin in range(0, len(owner), CHUNK):
        some = slice(begin, begin + CHUNK)
        prolong.data[some] = np.matmul(-damped[owner[some]], prolong.data[some])
    own = np.flatnonzero(prolong.indices == aggregate[owner])
    if len(own) == n:
        prolong.data[own] += blocks
    else:  # scipy leaves out what cancels, where blocks are numbers
        prolong = _as_blocks(prolong + rigid, size)
    del blocks, rigid, owner, own, rows  # their memory is better spent on what follows
    restrict = _as_blocks(prolong.transpose(), size)
    return Level(damped, prolong, restrict, _galerkin(matrix, prolong, restrict))


def _galerkin(matrix: bsr_matrix, prolong: bsr_matrix, restrict: bsr_matrix) -> bsr_matrix:
    """Pᵀ A P, some of its rows at a time, for the memory of Pᵀ A."""
    size, count = matrix.blocksize[0], prolong.shape[1] // matrix.blocksize[0]
    parts = [_rows(restrict, begin) @ matrix @ prolong for begin in range(0, count, ROWS)]
    data, indices = np.concatenate([p.data for p in parts]), np.concatenate([p.indices for p in parts])
    indptr = np.cumsum(np.concatenate([[0], *(np.diff(p.indptr) for p in parts)]))
    return _as_blocks(bsr_matrix((data, indices, indptr), shape=(count * size, count * size)), size)


def _rows(matrix: bsr_matrix, begin: int) -> bsr_matrix:
    """At most `ROWS` block rows of a matrix, its data shared."""
    indptr = matrix.indptr[begin : begin + ROWS + 1]
    part, size = slice(indptr[0], indptr[-1]), matrix.blocksize[0]
    shape = ((len(indptr) - 1) * size, matrix.shape[1])
    return bsr_matrix((matrix.data[part], matrix.indices[part], indptr - indptr[0]), shape=shape)


def _spectral_radius(matrix: bsr_matrix, inverse: Floats) -> float:
    """Of D⁻¹ A, by the power method."""
    size = matrix.blocksize[0]
    x = np.random.default_rng(1).normal(size=matrix.shape[0])
    radius = 1.0
    for _ in range(POWER_STEPS):
        x = np.matmul(inverse, (matrix @ x).reshape(-1, size, 1)).reshape(-1)
        radius = float(np.linalg.norm(x))
        x /= radius
    return SAFE_RADIUS * radius
