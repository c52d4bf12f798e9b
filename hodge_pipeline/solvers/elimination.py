"""The plan of a block elimination: in which order a graph's vertices go, many at a time, and what fill they leave.

Each round takes an independent set of vertices of few neighbours. What is left, the core, is small on graphs that are
like trajectories, and goes to a sparse direct solver. Rounds and fill depend on the graph alone: planned once, then
used for matrices with blocks of any size (solvers/block_factor.py).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations

import numpy as np
from scipy.sparse import csc_matrix, csr_matrix

from hodge_pipeline.types import Bools, Ints

MOST_NEIGHBOURS = 8
"""A vertex of more stays in the core: there a library's dense blocks are faster."""
SMALLEST_ROUND = 0.02
"""Of the vertices left: smaller rounds are not worth their overhead."""
FEWEST_IN_ROUND = 2000
"""Vertices, for the same reason."""
PASSES = 3
"""Of Luby's algorithm in a round: what they leave out is there for the next."""


@dataclass(frozen=True)
class Ordering:
    """Rows (n,) in the order of elimination; `fill` entries of the factor and `work` = Σ of its columns' counts²."""

    order: Ints
    work: float
    fill: float


@dataclass(frozen=True)
class Group:
    """Vertices of one round with k neighbours each, which later rounds or the core hold.

    - `begin`, `end`: their positions in the order; `neighbours (m, k)` the positions of theirs, ascending.
    - `slots`: of their blocks above the diagonal, vertex by vertex.
    - `scatter`: sums what their elimination adds, pair a ≤ b by pair of neighbours, into `targets`, which count the
      diagonal blocks first and then the others.
    """

    begin: int
    end: int
    slots: slice
    neighbours: Ints
    targets: Ints
    scatter: csr_matrix

    @cached_property
    def blocks(self) -> Ints:
        """The target (k, k, m) of each pair of neighbours, the smaller first; no other is set."""
        k = self.neighbours.shape[1]
        out = np.zeros((k, k, len(self.neighbours)), np.int64)
        out[np.triu_indices(k)] = self.targets[self.scatter.tocsc().indices].reshape(-1, len(self.neighbours))
        return out

    @cached_property
    def gather(self) -> csr_matrix:
        """Sums values (m · k) at the distinct neighbours, `reached`."""
        unique, inverse = np.unique(self.neighbours, return_inverse=True)
        count = self.neighbours.size
        return csr_matrix((np.ones(count), (inverse.reshape(-1), np.arange(count))), shape=(len(unique), count))

    @cached_property
    def reached(self) -> Ints:
        """The distinct neighbours."""
        return np.unique(self.neighbours)


@dataclass(frozen=True)
class Elimination:
    """The rounds for one graph: `order (n,)` gives the vertex at each position, those from `core` on are left over.

    `slot_rows`, `slot_columns` are the positions of each block above the diagonal, the core's own fill left out;
    `work` counts the products of blocks in a factorisation, and `fill` the blocks of the factor.
    """

    order: Ints
    core: int
    groups: tuple[Group, ...]
    slot_rows: Ints
    slot_columns: Ints
    work: float
    fill: float

    @property
    def size(self) -> int:
        """How many vertices there are."""
        return len(self.order)

    @cached_property
    def keys(self) -> Ints:
        """Ascending: row · n + column of each slot."""
        return self.slot_rows * self.size + self.slot_columns


def unordered(count: int) -> Elimination:
    """The plan that leaves the vertices as they are, for a graph that will not be factorised."""
    none = np.zeros(0, np.int64)
    return Elimination(np.arange(count), 0, (), none, none, math.inf, math.inf)


def plan_elimination(
    tail: Ints,
    head: Ints,
    count: int,
    core_order: Callable[[csc_matrix], Ordering],
    most_neighbours: int = MOST_NEIGHBOURS,
    fewest: int = FEWEST_IN_ROUND,
    smallest_core: int = 0,
) -> Elimination:
    """The rounds for a graph of `count` vertices with edges (tail, head); those at or past `count` are pinned.

    `core_order` gives the elimination order of the core's pattern. A vertex of more than `most_neighbours` stays in the
    core, and so do all when a round would have less than `fewest`, or where no more than `smallest_core` are left.
    """
    inside = (tail < count) & (head < count) & (tail != head)
    low, high = np.minimum(tail, head)[inside], np.maximum(tail, head)[inside]
    pairs = np.unique(low * count + high)
    alive = np.ones(count, bool)
    priority = np.random.default_rng(0).permutation(count)
    rounds: list[tuple[Ints, Ints]] = []
    left = count
    while left > smallest_core:
        low, high = np.divmod(pairs, count)
        chosen = _independent(low, high, alive, left, priority, most_neighbours, fewest)
        if chosen is None:
            break
        touched = chosen[low] | chosen[high]
        vertex = np.where(chosen[low], low, high)[touched]
        other = (low + high)[touched] - vertex
        groups = _by_degree(np.flatnonzero(chosen), vertex, other)
        rounds += groups
        pairs = _merged(pairs[~touched], [keys for _, neighbours in groups for keys in _fill(neighbours, count)])
        alive &= ~chosen
        left = int(alive.sum())
    rest = np.flatnonzero(alive)
    low, high = np.divmod(pairs, count)
    return _planned(count, rounds, _ordered_core(rest, low, high, count, core_order), low, high)


def _fill(neighbours: Ints, count: int) -> Iterator[Ints]:
    """The keys (m,) of the edges that eliminating m vertices adds: each two of their neighbours (m, k) are joined."""
    for a, b in combinations(range(neighbours.shape[1]), 2):
        first, second = neighbours[:, a], neighbours[:, b]
        yield np.minimum(first, second) * count + np.maximum(first, second)


def _merged(ascending: Ints, more: list[Ints]) -> Ints:
    """Distinct keys, ascending, of some that are so already and others: two runs, which the sort merges."""
    keys = np.concatenate([ascending, np.sort(np.concatenate([*more, ascending[:0]]))])
    keys.sort(kind="stable")
    return keys[np.diff(keys, prepend=-1) > 0]


def _independent(
    low: Ints, high: Ints, alive: Bools, left: int, priority: Ints, most_neighbours: int, fewest: int
) -> Bools | None:
    """Vertices of few neighbours, no two of them neighbours; None where there are too few."""
    count = len(alive)
    degree = np.bincount(low, minlength=count) + np.bincount(high, minlength=count)
    most = _highest_degree(degree[alive], left, most_neighbours, fewest)
    if most is None:
        return None
    candidate = alive & (degree <= most)
    rank = degree * count + priority
    return independent_set(low, high, candidate, rank, PASSES)


def independent_set(tail: Ints, head: Ints, candidate: Bools, rank: Ints, passes: int | None = None) -> Bools:
    """Candidates (n,) no two of which an edge joins, those of lowest rank first (Luby 1986).

    As many as there can be, unless the passes are limited. Ranks are distinct.
    """
    candidate, chosen = candidate.copy(), np.zeros(len(candidate), bool)
    apart = tail != head
    tail, head = tail[apart], head[apart]
    while candidate.any() and passes != 0:
        both = candidate[tail] & candidate[head]
        tail, head = tail[both], head[both]
        best = candidate.copy()
        best[np.where(rank[tail] > rank[head], tail, head)] = False
        chosen |= best
        candidate &= ~best
        candidate[head[best[tail]]] = False
        candidate[tail[best[head]]] = False
        passes = None if passes is None else passes - 1
    return chosen


def _highest_degree(degrees: Ints, left: int, most_neighbours: int, fewest: int) -> int | None:
    """The least degree up to which there are enough vertices for a round."""
    enough = max(SMALLEST_ROUND * left, fewest)
    upto = np.cumsum(np.bincount(degrees, minlength=most_neighbours + 1)[: most_neighbours + 1])
    found = np.flatnonzero(upto >= enough)
    return int(found[0]) if len(found) else None


def _by_degree(chosen: Ints, vertex: Ints, other: Ints) -> list[tuple[Ints, Ints]]:
    """Vertices (m,) with their neighbours (m, k), for each k."""
    order = np.argsort(vertex, kind="stable")
    vertex, other = vertex[order], other[order]
    begin = np.searchsorted(vertex, chosen)
    degree = np.searchsorted(vertex, chosen, side="right") - begin
    return [(chosen[degree == k], other[begin[degree == k, None] + np.arange(k)]) for k in np.unique(degree)]


def _ordered_core(
    rest: Ints, low: Ints, high: Ints, count: int, core_order: Callable[[csc_matrix], Ordering]
) -> Ordering:
    """The vertices of the core in elimination order."""
    place = np.zeros(count, np.int64)
    place[rest] = np.arange(len(rest))
    rows, columns, own = place[low], place[high], np.arange(len(rest))
    i, j = np.concatenate([rows, columns, own]), np.concatenate([columns, rows, own])
    weights = np.full(len(i), -1.0)
    weights[2 * len(rows) :] = np.bincount(i)
    found = core_order(csc_matrix((weights, (i, j)), (len(rest), len(rest))))
    return replace(found, order=rest[found.order])


def _planned(count: int, rounds: list[tuple[Ints, Ints]], core: Ordering, low: Ints, high: Ints) -> Elimination:
    """The plan of rounds, vertices (m,) with their neighbours (m, k), and a core with edges (low, high)."""
    order = np.concatenate([*(vertices for vertices, _ in rounds), core.order]).astype(np.int64)
    position = np.empty(count, np.int64)
    position[order] = np.arange(count)
    neighbours = [np.sort(position[others], axis=1) for _, others in rounds]
    begins = np.cumsum([0, *(len(vertices) for vertices, _ in rounds)])
    rows = [np.repeat(np.arange(b, b + len(n)), n.shape[1]) for b, n in zip(begins[:-1], neighbours, strict=True)]
    first, second = position[low], position[high]
    keys = np.sort(np.minimum(first, second) * count + np.maximum(first, second))
    core_rows, core_columns = np.divmod(keys, max(count, 1))
    slot_rows = np.concatenate([*rows, core_rows]).astype(np.int64)
    slot_columns = np.concatenate([*(n.reshape(-1) for n in neighbours), core_columns]).astype(np.int64)
    slot_ends = np.cumsum([0, *(len(r) for r in rows)])
    all_keys = slot_rows * count + slot_columns
    groups = []
    for number, near in enumerate(neighbours):
        targets, scatter = _scatter(near, all_keys, count)
        slots = slice(int(slot_ends[number]), int(slot_ends[number + 1]))
        groups.append(Group(int(begins[number]), int(begins[number + 1]), slots, near, targets, scatter))
    counts = [(len(near), near.shape[1] + 1) for near in neighbours]
    work, fill = (sum(m * float(k) ** power for m, k in counts) for power in (2, 1))
    return Elimination(
        order, int(begins[-1]), tuple(groups), slot_rows, slot_columns, work + core.work, fill + core.fill
    )


def _scatter(near: Ints, keys: Ints, count: int) -> tuple[Ints, csr_matrix]:
    """A group's `targets` and `scatter`, from its neighbours (m, k) and the ascending `keys` of all slots."""
    k = near.shape[1]
    targets = [
        near[:, a] if a == b else count + np.searchsorted(keys, near[:, a] * count + near[:, b])
        for a in range(k)
        for b in range(a, k)
    ]
    if not targets:
        return np.zeros(0, np.int64), csr_matrix((0, 0))
    unique, inverse = np.unique(np.concatenate(targets), return_inverse=True)
    entries = np.ones(len(inverse)), (inverse.reshape(-1), np.arange(len(inverse)))
    return unique.astype(np.int64), csr_matrix(entries, shape=(len(unique), len(inverse)))
