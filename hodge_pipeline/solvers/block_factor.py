"""A block matrix factorised by a plan of elimination: many small pivots at a time, the core by a sparse direct solver.

Chains and ladders need no library.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.sparse import bsr_matrix, csc_matrix

from hodge_pipeline.solvers.elimination import Elimination, Group
from hodge_pipeline.types import Floats


@dataclass(frozen=True)
class BlockFactor:
    """A block matrix after its elimination: `pivots (core, s, s)` inverted, `rows (slots, s, s)` divided by them."""

    plan: Elimination
    pivots: Floats
    rows: Floats
    solve_core: Callable[[Floats], Floats]

    def solve(self, rhs: Floats) -> Floats:
        """The solution of `matrix @ x = rhs`, of the right-hand side's shape (n · s,) or (n · s, c)."""
        size = self.pivots.shape[-1]
        x = np.array(rhs, self.rows.dtype).reshape(self.plan.size, size, -1)
        columns = x.shape[-1]
        for group in self.plan.groups:
            own = x[group.begin : group.end]
            if group.neighbours.shape[1]:
                blocks = self.rows[group.slots].reshape(*group.neighbours.shape, size, size)
                passed = np.matmul(blocks.transpose(0, 1, 3, 2), own[:, None])
                moved = group.gather @ passed.reshape(-1, size * columns)
                x[group.reached] -= moved.reshape(-1, size, columns)
        core = self.plan.core
        if core < self.plan.size:
            x[core:] = self.solve_core(x[core:].reshape(-1, columns)).reshape(-1, size, columns)
        for group in reversed(self.plan.groups):
            count, k = group.neighbours.shape
            wide = side_by_side(self.rows[group.slots].reshape(count, k, size, size))
            own = self.pivots[group.begin : group.end] @ x[group.begin : group.end]
            x[group.begin : group.end] = own - wide @ x[group.neighbours].reshape(count, k * size, columns)
        return np.asarray(x.reshape(rhs.shape), float)


def side_by_side(blocks: Floats) -> Floats:
    """Blocks (m, k, s, s) as one (m, s, k · s) of each vertex: one product in place of k."""
    count, k, size, _ = blocks.shape
    return blocks.transpose(0, 2, 1, 3).reshape(count, size, k * size)


def eliminate_blocks(
    plan: Elimination,
    diagonal: Floats,
    rows: Floats,
    factorise_core: Callable[[csc_matrix], Callable[[Floats], Floats]],
) -> BlockFactor:
    """The factor of the positive definite matrix of these blocks: `diagonal (n, s, s)`, and `rows (slots, s, s)` above
    it; both are overwritten.
    """
    size = diagonal.shape[-1]
    flat = diagonal.reshape(-1, size * size), rows.reshape(-1, size * size)
    for group in plan.groups:
        _eliminate_group(group, diagonal, rows, flat)
    core = _core_matrix(plan, diagonal, rows) if plan.core < plan.size else None
    solve_core = (lambda rhs: rhs) if core is None else factorise_core(core)
    end = plan.groups[-1].slots.stop if plan.groups else 0
    return BlockFactor(plan, diagonal[: plan.core], rows[:end], solve_core)


def unpacked(plan: Elimination, matrix: bsr_matrix) -> tuple[Floats, Floats]:
    """The diagonal blocks of a symmetric matrix in the plan's order, and those above it, with zeros for the fill."""
    size, n = matrix.blocksize[0], plan.size
    at = np.repeat(np.arange(n), np.diff(matrix.indptr))
    columns = matrix.indices.astype(np.int64)
    diagonal = np.zeros((n, size, size), matrix.data.dtype)
    on = at == columns
    diagonal[at[on]] = matrix.data[on]
    rows = np.zeros((len(plan.slot_rows), size, size), matrix.data.dtype)
    above = np.flatnonzero(at < columns)
    rows[np.searchsorted(plan.keys, at[above] * n + columns[above])] = matrix.data[above]
    return diagonal, rows


def _eliminate_group(group: Group, diagonal: Floats, rows: Floats, flat: tuple[Floats, Floats]) -> None:
    """Invert the group's pivots, divide its rows by them, and subtract Rᵀ D⁻¹ R from what is left, in place.

    `flat`: views of `diagonal` and `rows` with a block to a row.
    """
    size, (count, k) = rows.shape[-1], group.neighbours.shape
    pivots = diagonal[group.begin : group.end]
    pivots[:] = np.linalg.inv(pivots)
    if not k:
        return
    blocks = rows[group.slots].reshape(count, k, size, size)
    wide = side_by_side(blocks)
    divided = pivots @ wide
    added, row = np.empty((k * (k + 1) // 2, count, size, size), rows.dtype), 0
    for a in range(k):
        with_later = wide[:, :, a * size : (a + 1) * size].transpose(0, 2, 1) @ divided[:, :, a * size :]
        added[row : row + k - a] = with_later.reshape(count, size, k - a, size).transpose(2, 0, 1, 3)
        row += k - a
    total = group.scatter @ added.reshape(-1, size * size)
    on = int(np.searchsorted(group.targets, len(diagonal)))
    flat[0][group.targets[:on]] -= total[:on]
    flat[1][group.targets[on:] - len(diagonal)] -= total[on:]
    blocks[:] = divided.reshape(count, size, k, size).transpose(0, 2, 1, 3)


def _core_matrix(plan: Elimination, diagonal: Floats, rows: Floats) -> csc_matrix:
    """The Schur complement that is left for the core's solver."""
    begin, size = plan.core, rows.shape[-1]
    first = plan.groups[-1].slots.stop if plan.groups else 0
    at, columns = plan.slot_rows[first:] - begin, plan.slot_columns[first:] - begin
    count = plan.size - begin
    i = np.concatenate([np.arange(count), at, columns])
    j = np.concatenate([np.arange(count), columns, at])
    data = np.concatenate([diagonal[begin:], rows[first:], rows[first:].transpose(0, 2, 1)])
    order = np.lexsort((j, i))
    indptr = np.searchsorted(i[order], np.arange(count + 1))
    return by_columns(bsr_matrix((data[order], j[order], indptr), shape=(count * size, count * size)))


def by_columns(matrix: bsr_matrix) -> csc_matrix:
    """A symmetric matrix by its columns, which are its rows."""
    rows = matrix.tocsr()
    return csc_matrix((rows.data, rows.indices, rows.indptr), shape=rows.shape)
