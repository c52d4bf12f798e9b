"""Cycle bases of a graph, and how far the product of motions along each loop is from the identity."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import breadth_first_order

from hodge_pipeline import se3
from hodge_pipeline.complex.components import connected_components, first_of_component
from hodge_pipeline.types import Bools, Floats, Ints

LARGEST_BATCH = 100_000
"""Motions that are multiplied at once, 128 bytes each, held four times."""


@dataclass(frozen=True)
class SpanningForest:
    """A breadth-first tree for each connected component; short paths, so short loops.

    `parent (V,)` and `parent_edge (V,)` are −1 at a root; `sign (V,)` is +1 where that edge runs from the parent to
    the vertex; `depth (V,)`; `chords (C,)` are the edges outside the forest, self-loops and repeats included.
    """

    edges: Ints
    parent: Ints
    parent_edge: Ints
    sign: Ints
    depth: Ints
    chords: Ints


@dataclass(frozen=True)
class Loops:
    """Closed walks in columns: loop n passes `edge[offsets[n]:offsets[n + 1]]` in this order.

    `sign` is +1 where an edge is passed in its own direction. `offsets (L + 1,)`.
    """

    offsets: Ints
    edge: Ints
    sign: Ints

    def __len__(self) -> int:
        return len(self.offsets) - 1

    @classmethod
    def joined(cls, parts: Sequence[Loops]) -> Loops:
        """The loops of all parts, one after the other."""
        lengths = np.concatenate([part.lengths for part in parts])
        offsets = np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64)
        return cls(
            offsets, np.concatenate([part.edge for part in parts]), np.concatenate([part.sign for part in parts])
        )

    @property
    def lengths(self) -> Ints:
        """Edges of each loop, (L,)."""
        return np.diff(self.offsets)

    @property
    def rows(self) -> Ints:
        """The loop (N,) that each entry of `edge` belongs to."""
        return np.repeat(np.arange(len(self)), self.lengths)

    def sums(self, of_edge: Floats | Bools) -> Floats:
        """The sum (L,) of `of_edge (E,)` over the edges that each loop passes."""
        return np.bincount(self.rows, of_edge[self.edge], len(self)).astype(float)

    def sums_at_edges(self, of_loop: Floats | Bools, edge_count: int) -> Floats:
        """The sum (E,) of `of_loop (L,)` over the loops that pass each edge."""
        return np.bincount(self.edge, of_loop[self.rows], edge_count).astype(float)

    def missing(self, edge_count: int) -> Bools:
        """The edges (E,) that no loop passes."""
        out = np.ones(edge_count, bool)
        out[self.edge] = False
        return out

    def incidence(self, edge_count: int) -> csr_matrix:
        """The loops as 1-chains, (L, E): how often each passes each edge, with sign."""
        values = self.sign.astype(float)
        matrix = csr_matrix((values, (self.rows, self.edge)), shape=(len(self), edge_count))
        matrix.eliminate_zeros()
        return matrix

    def vertices(self, edges: Ints) -> Ints:
        """The vertices (N,) along the loops of edges (E, 2), one loop after the other."""
        return np.asarray(edges[self.edge, np.where(self.sign > 0, 0, 1)])

    def select(self, rows: Ints) -> Loops:
        """These loops, in this order."""
        lengths = self.lengths[rows]
        offsets = np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64)
        entry = np.repeat(self.offsets[:-1][rows] - offsets[:-1], lengths) + np.arange(offsets[-1])
        return Loops(offsets, self.edge[entry], self.sign[entry])

    def reversed_edges(self, turned: Bools) -> Loops:
        """The same loops where some edges (E,) are written the other way round."""
        return Loops(self.offsets, self.edge, np.where(turned[self.edge], -self.sign, self.sign))


def spanning_forest(edges: Ints, vertex_count: int, roots: Ints | None = None) -> SpanningForest:
    """A breadth-first tree of each component from its first vertex, or from `roots`, one of each component; the first
    of parallel edges is in the tree.
    """
    edges = np.asarray(edges, np.int64).reshape(-1, 2)
    if roots is None:
        roots = np.flatnonzero(first_of_component(connected_components(edges, vertex_count)))
    parent = _breadth_first_parents(edges, roots, vertex_count)
    child = np.flatnonzero(parent >= 0)
    parent_edge = np.full(vertex_count, -1, np.int64)
    parent_edge[child] = edge_between(edges, vertex_count, parent[child], child)
    sign = np.ones(vertex_count, np.int64)
    sign[child] = np.where(edges[parent_edge[child], 1] == child, 1, -1)
    in_tree = np.zeros(len(edges), bool)
    in_tree[parent_edge[child]] = True
    return SpanningForest(edges, parent, parent_edge, sign, _depths(parent), np.flatnonzero(~in_tree))


def _breadth_first_parents(edges: Ints, roots: Ints, vertex_count: int) -> Ints:
    # one more vertex, joined to every root, makes a single search of all components
    hub = vertex_count
    rows = np.concatenate([edges[:, 0], roots])
    columns = np.concatenate([edges[:, 1], np.full(len(roots), hub)])
    adjacency = csr_matrix((np.ones(len(rows), np.int8), (rows, columns)), shape=(hub + 1, hub + 1))
    _, parent = breadth_first_order(adjacency, hub, directed=False, return_predecessors=True)
    parents = np.asarray(parent[:hub], np.int64)
    parents[roots] = -1
    return parents


def edge_between(edges: Ints, vertex_count: int, a: Ints, b: Ints) -> Ints:
    """The row (N,) of the first edge between vertices a and b (N,), in either direction; each pair must have one."""
    key = edges.min(axis=1) * vertex_count + edges.max(axis=1)
    keys, first = np.unique(key, return_index=True)
    wanted = np.minimum(a, b) * vertex_count + np.maximum(a, b)
    return np.asarray(first[np.searchsorted(keys, wanted)], np.int64)


def _depths(parent: Ints) -> Ints:
    above, depth = parent.copy(), (parent >= 0).astype(np.int64)
    active = np.flatnonzero(above >= 0)
    while len(active):
        depth[active] += depth[above[active]]
        above[active] = above[above[active]]
        active = active[above[active] >= 0]
    return depth


def fundamental_loops(forest: SpanningForest, chords: Ints | None = None) -> Loops:
    """The loop of each chord (i, j): along the chord from i to j, then through the tree back to i, its base vertex.

    Together they are a basis of the cycle space, E − V + C loops. `chords` picks some of the forest's chords.
    """
    chords = forest.chords if chords is None else np.asarray(chords, np.int64)
    up_from_j, up_from_i = _tree_paths(forest, forest.edges[chords, 1], forest.edges[chords, 0])
    # (loop, place in loop, edge, sign): up from j, then down to i, which is the way up from i backwards
    row = np.concatenate([np.arange(len(chords)), up_from_j[0], up_from_i[0]])
    place = np.concatenate([np.full(len(chords), -1), up_from_j[1], np.iinfo(np.int64).max - up_from_i[1]])
    vertex = np.concatenate([up_from_j[2], up_from_i[2]])
    edge = np.concatenate([chords, forest.parent_edge[vertex]])
    along_tree = np.concatenate([-forest.sign[up_from_j[2]], forest.sign[up_from_i[2]]])
    sign = np.concatenate([np.ones(len(chords), np.int64), along_tree])
    order = np.lexsort((place, row))
    offsets = np.concatenate([[0], np.cumsum(np.bincount(row, minlength=len(chords)))]).astype(np.int64)
    return Loops(offsets, edge[order], sign[order])


def _tree_paths(forest: SpanningForest, a: Ints, b: Ints) -> tuple[tuple[Ints, Ints, Ints], tuple[Ints, Ints, Ints]]:
    """(row, step, vertex) of the climbs from a and from b to where they meet: vertices whose parent edge is passed."""
    a, b = a.copy(), b.copy()
    climbs: tuple[list[tuple[Ints, Ints, Ints]], list[tuple[Ints, Ints, Ints]]] = ([], [])
    active = np.flatnonzero(a != b)
    step = 0
    while len(active):
        depth_a, depth_b = forest.depth[a[active]], forest.depth[b[active]]
        for side, end, moves in ((0, a, depth_a >= depth_b), (1, b, depth_b >= depth_a)):
            rows = active[moves]
            climbs[side].append((rows, np.full(len(rows), step), end[rows]))
            end[rows] = forest.parent[end[rows]]
        active = active[a[active] != b[active]]
        step += 1
    return _joined(climbs[0]), _joined(climbs[1])


def _joined(parts: list[tuple[Ints, Ints, Ints]]) -> tuple[Ints, Ints, Ints]:
    empty = np.zeros(0, np.int64)
    row, step, vertex = (np.concatenate([empty, *(part[k] for part in parts)]) for k in range(3))
    return row, step, vertex


def root_from_vertex(forest: SpanningForest, i_from_j: Floats) -> Floats:
    """Motions (V, 4, 4) chained along the forest; the identity at each root."""
    child = np.flatnonzero(forest.parent >= 0)
    motion = _identities(len(forest.parent))
    motion[child] = directed(i_from_j, forest.parent_edge[child], forest.sign[child])
    above = forest.parent.copy()
    active = child
    while len(active):
        # every round doubles the length of path that a motion spans: deep trees cost log(depth) rounds
        motion[active] = motion[above[active]] @ motion[active]
        above[active] = above[above[active]]
        active = active[above[active] >= 0]
    return motion


def fundamental_products(forest: SpanningForest, i_from_j: Floats, chords: Ints | None = None) -> Floats:
    """The motion (C, 4, 4) around each fundamental loop from its base vertex: `Z_ij · j_from_root · root_from_i`.

    What lies above the meeting point of the two tree paths cancels, so the cost does not grow with the loops' length.
    """
    chords = forest.chords if chords is None else np.asarray(chords, np.int64)
    root_from = root_from_vertex(forest, i_from_j)
    i, j = forest.edges[chords].T
    return np.asarray(i_from_j[chords] @ se3.inverse(root_from[j]) @ root_from[i])


def loop_products(loops: Loops, i_from_j: Floats) -> Floats:
    """The ordered product (L, 4, 4) of the edges' motions along each loop, inverse where passed backwards."""
    out = _identities(len(loops))
    start = 0
    while start < len(loops):
        limit = loops.offsets[start] + LARGEST_BATCH
        stop = max(start + 1, int(np.searchsorted(loops.offsets, limit, side="right")) - 1)
        out[start:stop] = _batch_products(loops.select(np.arange(start, stop)), i_from_j)
        start = stop
    return out


def _batch_products(loops: Loops, i_from_j: Floats) -> Floats:
    motion = directed(i_from_j, loops.edge, loops.sign)
    row = loops.rows
    place = np.arange(len(row)) - loops.offsets[:-1][row]
    while len(place) and place.max() > 0:
        # neighbours (0, 1), (2, 3), … of every loop at once; a last one without a partner stays
        left = place % 2 == 0
        paired = np.flatnonzero(left[:-1] & (row[1:] == row[:-1]))
        motion[paired] = motion[paired] @ motion[paired + 1]
        motion, row, place = motion[left], row[left], place[left] // 2
    out = _identities(len(loops))
    out[row] = motion
    return out


def _identities(count: int) -> Floats:
    return np.asarray(np.broadcast_to(np.eye(4), (count, 4, 4)).copy())


def directed(i_from_j: Floats, edge: Ints, sign: Ints) -> Floats:
    """The motions (N, 4, 4) of edges (N,), inverse where `sign (N,)` is −1."""
    motion = np.asarray(i_from_j[edge])
    backwards: Bools = sign < 0
    motion[backwards] = se3.inverse(motion[backwards])
    return motion


def loop_deviation(motions: Floats) -> Floats:
    """‖M − I₄‖_F (L,) of the motions around loops: the terms of the paper's D (Eq. (10))."""
    return np.asarray(np.linalg.norm(motions - np.eye(4), axis=(-2, -1)))


def adjusted_edges(edges: Ints, world_from_cam: Floats, correction: Floats, pairing: bool) -> Floats:
    """The adjusted edges `A_ij = T_i⁻¹ exp(f_j − f_i) T_j` (E, 4, 4) of one Poisson step.

    `world_from_cam` are the poses before the step and `correction (V, 6)` is its f. Their loop deviation says how far
    the exponential of the sum is from the product of the exponentials; from the poses after the step it would be 0 by
    construction.
    """
    i, j = edges.T
    step = correction[j] - correction[i]
    motion = se3.pairing_exp(step) if pairing else se3.exp(step)
    return np.asarray(se3.inverse(world_from_cam[i]) @ motion @ world_from_cam[j])
