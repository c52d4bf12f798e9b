"""A preconditioner for graphs too large, or too tangled, to factorise: smoothed aggregation multigrid.

Vaněk, Mandel and Brezina 1996, with the motions of a rigid body in the place of elasticity's: a cluster of poses that
moves as one leaves the edges within it as they are, so that one coarse vertex can stand for it. Such modes are what the
scalar Laplacians miss, whose levers couple rotations to translations.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from scipy.sparse import bsr_matrix, csc_matrix, csr_matrix, diags_array

from hodge_pipeline.solvers.elimination import independent_set
from hodge_pipeline.solvers.linear import fill_reducing_order
from hodge_pipeline.solvers.rotations import lever
from hodge_pipeline.types import Floats, Ints

COARSEST = 3000
"""Vertices that are factorised whatever their fill."""
MOST_NEIGHBOURS_TRIED = 9
"""Of a vertex, itself counted: levels with more fill up."""
FACTOR_WORTH = 20
"""Products of blocks for each block of the matrix that the factor of a level may take: it saves levels, and steps."""
LEAST_COARSENING = 0.8
POWER_STEPS = 10
SAFE_RADIUS = 1.05
"""The power method's estimate is a lower bound of the spectral radius."""
CoarseSolver: TypeAlias = Callable[[csc_matrix], Callable[[Floats], Floats]]


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


def multigrid(matrix: bsr_matrix, modes: Modes, coarse: CoarseSolver) -> Multigrid:
    """The hierarchy of a symmetric positive definite block matrix with these modes.

    `coarse` factorises the matrix of the last level.
    """
    levels = []
    while not _worth_a_factor(matrix):
        size = matrix.blocksize[0]
        aggregate = aggregates(matrix)
        count = int(aggregate.max()) + 1
        if count > LEAST_COARSENING * len(aggregate):
            break
        coarse_modes = modes.gathered(aggregate, count)
        about = None if coarse_modes.positions is None else coarse_modes.positions[aggregate]
        level = _level(matrix, modes.blocks(len(aggregate), size, about), aggregate, count)
        modes = coarse_modes
        levels.append(level)
        matrix = level.coarser
    return Multigrid(tuple(levels), coarse(matrix.tocsc()))


def _worth_a_factor(matrix: bsr_matrix) -> bool:
    """Whether the matrix is small, or so like a tree that its factor fills up little."""
    count = len(matrix.indptr) - 1
    if count <= COARSEST:
        return True
    if len(matrix.indices) > MOST_NEIGHBOURS_TRIED * count:
        return False
    pattern = _pattern(matrix)
    pattern.data[:] = -1.0
    laplacian = pattern + diags_array(np.diff(pattern.indptr).astype(np.float32))
    return fill_reducing_order(laplacian).work < FACTOR_WORTH * len(matrix.indices)


def _pattern(matrix: bsr_matrix) -> csr_matrix:
    count = len(matrix.indptr) - 1
    return csr_matrix((np.ones(len(matrix.indices), np.float32), matrix.indices, matrix.indptr), shape=(count, count))


def _as_blocks(matrix: bsr_matrix, size: int) -> bsr_matrix:
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
    """The level with prolongation (I − ω D⁻¹ A) P, where P moves each aggregate as one."""
    size, n = matrix.blocksize[0], len(aggregate)
    rows = np.repeat(np.arange(n, dtype=np.int32), np.diff(matrix.indptr))
    inverse = np.linalg.inv(matrix.data[rows == matrix.indices])
    damped = inverse * (4 / 3 / _spectral_radius(matrix, inverse))
    shape = (n * size, count * size)
    rigid = bsr_matrix((blocks, aggregate, np.arange(n + 1)), shape=shape)
    smooth = _as_blocks(matrix @ rigid, size)
    owner = np.repeat(np.arange(n), np.diff(smooth.indptr))
    np.matmul(-damped[owner], smooth.data, out=smooth.data)
    prolong = _as_blocks(rigid + smooth, size)
    restrict = _as_blocks(prolong.transpose(), size)
    return Level(damped, prolong, restrict, _as_blocks(restrict @ (matrix @ prolong), size))


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
