"""Sparse normal equations of relative motions: solves, and the covariance across each edge by selected inversion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import lu_factor, lu_solve
from scipy.sparse import csc_matrix

from hodge_pipeline.complex.components import connected_components, first_of_component
from hodge_pipeline.solvers.block_factor import BlockFactor, eliminate_blocks, side_by_side
from hodge_pipeline.solvers.elimination import Elimination, Group, Ordering, plan_elimination
from hodge_pipeline.types import Floats, Ints

MOST_NEIGHBOURS, FEWEST_IN_ROUND, SMALLEST_CORE = 24, 6, 64
"""Most neighbours of a vertex that is eliminated in a round, fewest vertices of a round, and vertices of which a dense
core is inverted at once: smaller rounds take longer.
"""


@dataclass(frozen=True)
class NormalEquations:
    """The sparsity pattern of the normal equations of edges (E, 2), with one vertex of each `component (N,)` fixed.

    `place (N,)`: the rank of each vertex in the elimination order, from `plan.size` on for fixed ones; `slot (E,)`:
    each edge's block above the diagonal, −1 where an end is fixed.
    """

    edges: Ints
    component: Ints
    place: Ints
    slot: Ints
    plan: Elimination

    @classmethod
    def of(cls, edges: Ints, count: int) -> NormalEquations:
        """The pattern of edges between `count` vertices, without self-loops."""
        component = connected_components(edges, count)
        held = first_of_component(component)
        free = np.flatnonzero(~held)
        place = np.empty(count, np.int64)
        place[free], place[held] = np.arange(len(free)), np.arange(len(free), count)
        tail, head = place[edges].T
        plan = plan_elimination(tail, head, len(free), _natural_order, MOST_NEIGHBOURS, FEWEST_IN_ROUND, SMALLEST_CORE)
        place[free[plan.order]] = np.arange(len(free))
        low, high = np.sort(place[edges], axis=1).T
        slot = np.where(high < len(free), np.searchsorted(plan.keys, low * len(free) + high), -1)
        return cls(edges, component, place, slot, plan)

    def factor(self, precision: Floats, carry: Floats) -> Factored:
        """The normal equations' factor; `precision (E, p, p)` of each edge's `x_j − A x_i`, `carry (E, p, p)` is A."""
        size, p = self.plan.size, precision.shape[-1]
        diagonal, rows = np.zeros((size + 1, p, p)), np.zeros((len(self.plan.slot_rows), p, p))
        tail, head = np.minimum(self.place[self.edges], size).T
        pulled = np.swapaxes(carry, 1, 2) @ precision
        np.add.at(diagonal, head, precision)
        np.add.at(diagonal, tail, pulled @ carry)
        inside = self.slot >= 0
        off = np.where((tail < head)[:, None, None], pulled, np.swapaxes(pulled, 1, 2))
        np.add.at(rows, self.slot[inside], -off[inside])
        core: list[Floats] = [np.zeros((0, 0))]

        def solver(matrix: csc_matrix) -> object:
            core[0] = matrix.toarray()
            factored = lu_factor(core[0], check_finite=False)
            return lambda rhs: lu_solve(factored, rhs, check_finite=False)

        factor = eliminate_blocks(self.plan, diagonal[:size], rows, solver)  # type: ignore[arg-type]
        return Factored(self, carry, factor, core[0])


def _natural_order(pattern: csc_matrix) -> Ordering:
    return Ordering(np.arange(pattern.shape[0]), 0.0, 0.0)


@dataclass(frozen=True)
class Factored:
    """Factorised normal equations: `core` is the dense Schur complement that the rounds leave."""

    network: NormalEquations
    carry: Floats
    blocks: BlockFactor
    core: Floats

    @property
    def log_det(self) -> float:
        """The logarithm of the determinant of the normal equations."""
        return float(np.linalg.slogdet(self.core)[1] - np.linalg.slogdet(self.blocks.pivots)[1].sum())

    def solve(self, force: Floats) -> Floats:
        """The solution x (N, p, c) for right-hand sides (N, p, c); 0 at fixed vertices."""
        network = self.network
        size = network.plan.size
        out, rhs = np.zeros_like(force), np.empty((size, *force.shape[1:]))
        free = np.flatnonzero(network.place < size)
        rhs[network.place[free]] = force[free]
        flat = rhs.reshape(size * force.shape[1], -1)
        out[free] = self.blocks.solve(flat).reshape(rhs.shape)[network.place[free]] if size else 0.0
        return out

    def across(self) -> Floats:
        """The covariance (E, p, p) of `x_j − A x_i` of each edge: only those entries of the inverse that the factor has
        are computed (Takahashi et al. 1973).
        """
        network = self.network
        diagonal, rows = self._inverse()
        i, j = np.minimum(network.place[network.edges], network.plan.size).T
        off = np.where((network.slot >= 0)[:, None, None], rows[network.slot], 0.0)
        off = self.carry @ np.where((i < j)[:, None, None], off, np.swapaxes(off, 1, 2))
        own = diagonal[j] + self.carry @ diagonal[i] @ np.swapaxes(self.carry, 1, 2)
        return np.asarray(own - off - np.swapaxes(off, 1, 2))

    def _inverse(self) -> tuple[Floats, Floats]:
        plan, p = self.network.plan, self.carry.shape[-1]
        diagonal, rows = np.zeros((plan.size + 1, p, p)), np.zeros((len(plan.slot_rows) + 1, p, p))
        begin, left = plan.core, plan.size - plan.core
        dense = np.linalg.inv(self.core).reshape(left, p, left, p)
        diagonal[begin : plan.size] = np.einsum("iaib->iab", dense)
        first = plan.groups[-1].slots.stop if plan.groups else 0
        a, b = plan.slot_rows[first:] - begin, plan.slot_columns[first:] - begin
        rows[first:-1] = dense[a, :, b, :]
        for group in reversed(plan.groups):
            self._of_group(group, diagonal, rows)
        return diagonal, rows

    def _of_group(self, group: Group, diagonal: Floats, rows: Floats) -> None:
        plan, (count, k) = self.network.plan, group.neighbours.shape
        pivots = self.blocks.pivots[group.begin : group.end]
        p, each = pivots.shape[-1], np.arange(k)
        between = np.empty((count, k, k, p, p))
        between[:, each, each] = diagonal[group.neighbours]
        a, b = np.triu_indices(k, 1)
        off = rows[group.blocks[a, b].T - plan.size]
        between[:, a, b], between[:, b, a] = off, np.swapaxes(off, 2, 3)
        wide = side_by_side(self.blocks.rows[group.slots].reshape(count, k, p, p))
        across = -wide @ between.transpose(0, 1, 3, 2, 4).reshape(count, k * p, k * p)
        diagonal[group.begin : group.end] = pivots - across @ np.swapaxes(wide, 1, 2)
        rows[group.slots] = across.reshape(count, p, k, p).transpose(0, 2, 1, 3).reshape(count * k, p, p)
