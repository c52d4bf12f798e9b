"""A list of cycles that passes every edge which lies in one: triangles where there are any, then squares, then the
shortest loops of a tree.
"""

from __future__ import annotations

import numpy as np

from hodge_pipeline.complex.cech import flag_complex, orient_edges
from hodge_pipeline.complex.cycles import Loops, fundamental_loops, spanning_forest
from hodge_pipeline.types import Bools, Ints

NEIGHBOURS = 8
"""Neighbours of each end of an edge that are tried for a square: a limit on cost."""
EDGES_AT_ONCE = 20_000
"""With 64 pairs of neighbours each, whose columns take 10 MB apiece."""
LONGEST_ENTRIES = 5_000_000
"""Edges of all loops of chords together: a limit on memory."""


def short_cycles(edges: Ints, vertex_count: int, most_per_edge: int) -> Loops:
    """Cycles of the graph such that every edge that lies in one is in one of these, unless that would be too long.

    Pairs of parallel edges, triangles (thinned evenly where there are very many), squares for edges that have none
    of these, and for the rest the loops that their chords close in a breadth-first tree.
    """
    loops = Loops.joined([_parallel_pairs(edges, vertex_count), _triangles(edges, vertex_count, most_per_edge)])
    if (bare := loops.missing(len(edges))).any():
        loops = Loops.joined([loops, _squares(edges, vertex_count, np.flatnonzero(bare))])
    if loops.missing(len(edges)).any():
        loops = Loops.joined([loops, loops_of_chords(edges, vertex_count)])
    return _distinct(loops, len(edges))


def with_cycles_of(chosen: Bools, loops: Loops, edges: Ints, vertex_count: int, wanted: Bools) -> Loops:
    """These loops, and for wanted edges (E,) more of them that pass chosen edges (E,) alone.

    Two cycles that fail over one edge make a third without it, which may be the only one that closes.
    """
    rows = np.flatnonzero(chosen)
    more = loops_of_chords(edges[rows], vertex_count)
    more = Loops(more.offsets, rows[more.edge], more.sign)
    return _distinct(Loops.joined([loops, more.select(np.flatnonzero(more.sums(wanted)))]), len(edges))


def _distinct(loops: Loops, edge_count: int) -> Loops:
    """Each cycle once: a square is found from each of its edges that lack a triangle, and again as a loop of the tree.

    Cycles are the same where the sums of random numbers of their edges are, 64 bits each.
    """
    if not len(loops):
        return loops
    numbers = np.random.default_rng(0).integers(0, 2**64, edge_count, np.uint64)
    sums = np.add.reduceat(numbers[loops.edge], loops.offsets[:-1])
    last = len(loops) - 1 - np.unique(sums[::-1], return_index=True)[1]
    return loops if len(last) == len(loops) else loops.select(np.sort(last))


def _of_equal_length(edge: Ints, sign: Ints) -> Loops:
    count, length = edge.shape
    return Loops(np.arange(count + 1, dtype=np.int64) * length, edge.ravel(), sign.ravel())


def _parallel_pairs(edges: Ints, vertex_count: int) -> Loops:
    oriented = orient_edges(edges, vertex_count)
    order = np.lexsort((np.arange(len(edges)), oriented.row))
    same = (oriented.row[order][1:] == oriented.row[order][:-1]) & (oriented.row[order][1:] >= 0)
    first, second = order[:-1][same], order[1:][same]
    sign = np.stack([oriented.sign[first], -oriented.sign[second]], axis=1)
    return _of_equal_length(np.stack([first, second], axis=1), sign)


def _triangles(edges: Ints, vertex_count: int, most_per_edge: int) -> Loops:
    """Triangles of the first of parallel edges, thinned by a stride where an edge would be in too many."""
    complex_ = flag_complex(edges, vertex_count)
    corners = complex_.simplices[2]
    limit = max(most_per_edge * len(complex_.simplices[1]) // 3, 1)
    return _along(corners[:: max(-(-len(corners) // limit), 1)], edges, vertex_count)


def _along(corners: Ints, edges: Ints, vertex_count: int) -> Loops:
    """The loops that pass corners (N, K) in order along the first of parallel edges, where all are joined."""
    simple = orient_edges(edges, vertex_count)
    keys = simple.edges @ [vertex_count, 1]
    sides = np.sort(np.stack([corners, np.roll(corners, -1, axis=1)], axis=2), axis=2) @ [vertex_count, 1]
    place = np.minimum(np.searchsorted(keys, sides), len(keys) - 1)
    joined = (keys[place] == sides).all(axis=1)
    edge = simple.first[place[joined]]
    return _of_equal_length(edge, np.where(edges[edge, 0] == corners[joined], 1, -1))


def _squares(edges: Ints, vertex_count: int, wanted: Ints) -> Loops:
    """Cycles i–j–b–a–i for the wanted edges (i, j), over some neighbours a of i and b of j."""
    neighbours = _some_neighbours(orient_edges(edges, vertex_count).edges, vertex_count)
    found = []
    for start in range(0, len(wanted), EDGES_AT_ONCE):
        rows = np.repeat(wanted[start : start + EDGES_AT_ONCE], NEIGHBOURS**2)
        i, j = edges[rows].T
        a, b = (
            neighbours[i, np.arange(len(rows)) // NEIGHBOURS % NEIGHBOURS],
            neighbours[j, np.arange(len(rows)) % NEIGHBOURS],
        )
        possible = (a >= 0) & (b >= 0) & (a != j) & (b != i) & (a != b) & (i != j)
        found.append(_along(np.stack([i, j, b, a], axis=1)[possible], edges, vertex_count))
    return Loops.joined(found)


def _some_neighbours(edges: Ints, vertex_count: int) -> Ints:
    """Up to NEIGHBOURS neighbours (V, NEIGHBOURS) of each vertex, −1 where there are fewer."""
    tail, head = np.concatenate([edges[:, 0], edges[:, 1]]), np.concatenate([edges[:, 1], edges[:, 0]])
    order = np.lexsort((np.abs(head - tail), tail))
    tail, head = tail[order], head[order]
    rank = np.arange(len(tail)) - np.searchsorted(tail, tail)
    out = np.full((vertex_count, NEIGHBOURS), -1, np.int64)
    few = rank < NEIGHBOURS
    out[tail[few], rank[few]] = head[few]
    return out


def loops_of_chords(edges: Ints, vertex_count: int) -> Loops:
    """The fundamental loops of a spanning forest, without self-loops: the shortest, up to `LONGEST_ENTRIES` edges in
    all.
    """
    forest = spanning_forest(edges, vertex_count)
    chords = forest.chords[edges[forest.chords, 0] != edges[forest.chords, 1]]
    depth = forest.depth[edges[chords]].sum(axis=1)
    affordable = np.cumsum(np.sort(depth + 1)) <= LONGEST_ENTRIES
    order = np.argsort(depth, kind="stable")[affordable]
    return fundamental_loops(forest, chords[np.sort(order)])
