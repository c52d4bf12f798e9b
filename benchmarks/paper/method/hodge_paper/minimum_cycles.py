"""A cycle basis of least total length, for small graphs (Horton 1987): short loops localise errors best."""

from __future__ import annotations

from functools import partial

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra

from hodge_pipeline.complex.coboundary import check_edges
from hodge_pipeline.complex.cycles import Loops, loop_products, spanning_forest
from hodge_pipeline.errors import GraphError
from hodge_pipeline.solvers.potential import AroundLoops, tree_loops
from hodge_pipeline.types import Ints

MOST_CANDIDATES = 2_000_000


def minimum_cycle_basis(edges: Ints, vertex_count: int) -> Loops:
    """E − V + C loops of least total length, shortest first.

    Every loop of such a basis is an edge (x, y) and the shortest paths from some vertex v to both its ends (Horton);
    they are taken by length as long as they are independent over GF(2). Raises `GraphError` for a graph of more than
    2 million pairs (v, edge): take `fundamental_loops` there.
    """
    edges = np.asarray(edges, np.int64).reshape(-1, 2)
    check_edges(edges, vertex_count)
    if vertex_count * len(edges) > MOST_CANDIDATES:
        raise GraphError(
            f"a minimum cycle basis of {vertex_count} vertices and {len(edges)} edges takes too long: use the "
            "fundamental loops of a spanning tree"
        )
    return _independent(_Horton(edges, vertex_count), edges, vertex_count)


def shortest_loops(edges: Ints, vertex_count: int) -> AroundLoops:
    """The products around the shortest cycle basis, mostly triangles; where that takes too long, around a tree's."""
    if vertex_count * len(edges) > MOST_CANDIDATES:
        return tree_loops(edges, vertex_count)
    return partial(loop_products, minimum_cycle_basis(edges, vertex_count))


class _Horton:
    """Shortest-path trees from every vertex, and the loops that an edge closes in them, shortest first."""

    def __init__(self, edges: Ints, vertex_count: int) -> None:
        low, high = edges.min(axis=1), edges.max(axis=1)
        order = np.argsort(low * vertex_count + high, kind="stable")
        order = order[(low < high)[order]]
        keys, first = np.unique((low * vertex_count + high)[order], return_index=True)
        self.edges = edges
        self.edge_of_key: dict[int, int] = dict(zip(keys.tolist(), order[first].tolist(), strict=True))
        kept = order[first]
        adjacency = csr_matrix((np.ones(len(kept)), (low[kept], high[kept])), shape=(vertex_count, vertex_count))
        distance, self.parent = dijkstra(adjacency, directed=False, return_predecessors=True)
        total = distance[:, edges[:, 0]] + distance[:, edges[:, 1]]
        self.count = vertex_count
        flat = np.argsort(total, axis=None, kind="stable")
        self.order = flat[np.isfinite(total.ravel()[flat])]

    def loop(self, candidate: int) -> list[tuple[int, int]] | None:
        """(edge, sign) along x → y → … → v → … → x; None where it is not a simple loop."""
        vertex, edge = divmod(candidate, len(self.edges))
        x, y = self.edges[edge].tolist()
        back, forth = self._to_root(vertex, y), self._to_root(vertex, x)
        steps = [(edge, 1), *back, *((e, -s) for e, s in reversed(forth))]
        used = [e for e, _ in steps]
        return steps if len(set(used)) == len(used) else None

    def edge_between(self, a: int, b: int) -> int:
        """The first edge that joins two vertices."""
        return self.edge_of_key[min(a, b) * self.count + max(a, b)]

    def _to_root(self, root: int, vertex: int) -> list[tuple[int, int]]:
        steps = []
        while vertex != root:
            above = int(self.parent[root, vertex])
            edge = self.edge_between(above, vertex)
            steps.append((edge, 1 if self.edges[edge, 0] == vertex else -1))
            vertex = above
        return steps


def _independent(horton: _Horton, edges: Ints, vertex_count: int) -> Loops:
    chords = spanning_forest(edges, vertex_count).chords
    masks = _Masks(horton, {edge: 1 << place for place, edge in enumerate(chords.tolist())})
    reduced: dict[int, int] = {}
    chosen: list[list[tuple[int, int]]] = []
    for candidate in horton.order.tolist():
        if len(chosen) == len(chords):
            break
        left = _reduced(reduced, masks.of_candidate(candidate))
        steps = horton.loop(candidate) if left else None
        if steps is not None:
            reduced[left.bit_length()] = left
            chosen.append(steps)
    offsets = np.concatenate([[0], np.cumsum([len(steps) for steps in chosen])]).astype(np.int64)
    flat = np.array([step for steps in chosen for step in steps], np.int64).reshape(-1, 2)
    return Loops(offsets, flat[:, 0], flat[:, 1])


class _Masks:
    """The chords that a loop passes, as the bits of one number; the paths' shared part cancels."""

    def __init__(self, horton: _Horton, bit_of_chord: dict[int, int]) -> None:
        self.horton, self.bit = horton, bit_of_chord
        self.ends: list[list[int]] = horton.edges.tolist()
        self.masks: dict[int, int] = {}

    def of_candidate(self, candidate: int) -> int:
        root, edge = divmod(candidate, len(self.ends))
        x, y = self.ends[edge]
        return self._path(root, x) ^ self._path(root, y) ^ self.bit.get(edge, 0)

    def _path(self, root: int, vertex: int) -> int:
        base, climbed = root * self.horton.count, []
        while vertex != root and base + vertex not in self.masks:
            climbed.append(vertex)
            vertex = int(self.horton.parent[root, vertex])
        mask = self.masks.get(base + vertex, 0)
        for below in reversed(climbed):
            mask ^= self.bit.get(self.horton.edge_between(vertex, below), 0)
            self.masks[base + below] = mask
            vertex = below
        return mask


def _reduced(reduced: dict[int, int], mask: int) -> int:
    """What is left of a cycle modulo those kept, over GF(2): 0 where it depends on them."""
    while mask:
        other = reduced.get(mask.bit_length())
        if other is None:
            return mask
        mask ^= other
    return 0
