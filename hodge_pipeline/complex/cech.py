"""The Čech complex of the viewing graph: its cliques (flag complex), or those whose clouds really meet (nerve).

Definition 1 of the paper, and Section 4, "Cech Complex Construction".
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.sparse import csr_matrix

from hodge_pipeline.complex.coboundary import check_edges
from hodge_pipeline.errors import GraphError
from hodge_pipeline.types import Floats, Ints

CANDIDATES_AT_ONCE, SIMPLICES_AT_ONCE = 2_000_000, 2_000
"""Candidate triangles of a batch, and triangles of which occupancy is intersected at once: limits on memory."""
MOST_LISTED = 50_000_000
"""Triangles, 24 bytes each: a limit on memory."""


@dataclass(frozen=True)
class SimplicialComplex:
    """Vertices, edges and triangles: `simplices[k] (N_k, k + 1)` vertex rows, ascending in each row, rows in that
    order too. Of cliques of more vertices nothing that is computed here depends.

    The orientation of a simplex is that of its ascending vertices: an edge (i, j) has i < j.
    """

    simplices: tuple[Ints, ...]

    @property
    def counts(self) -> tuple[int, ...]:
        """How many simplices of each dimension."""
        return tuple(len(rows) for rows in self.simplices)

    @property
    def vertex_count(self) -> int:
        """How many vertices, isolated ones included."""
        return len(self.simplices[0])

    def rows_of(self, simplices: Ints) -> Ints:
        """The row (N,) of each simplex (N, k + 1) of ascending vertices, −1 where it is not in the complex."""
        order = simplices.shape[1] - 1
        if order == 0:
            return np.asarray(simplices[:, 0], np.int64)
        keys = self._keys(self.simplices[order])
        wanted = self._keys(simplices)
        place = np.minimum(np.searchsorted(keys, wanted), max(len(keys) - 1, 0))
        found = (keys[place] == wanted) & (wanted >= 0) if len(keys) else np.zeros(len(wanted), bool)
        return np.where(found, place, -1)

    def _keys(self, simplices: Ints) -> Ints:
        # the row of the face without the last vertex, then that vertex: never overflows, whatever the dimension
        prefix = self.rows_of(simplices[:, :-1])
        return np.where(prefix < 0, -1, prefix * self.vertex_count + simplices[:, -1])

    def coboundary(self, order: int) -> csr_matrix:
        """d_order (N_{order+1}, N_order) int8 of Eq. (1): `(d ω)_{0…p+1} = Σ (−1)^i ω_{0…î…p+1}`, rows as listed."""
        cofaces = self.simplices[order + 1]
        count, corners = cofaces.shape
        columns = [self.rows_of(np.delete(cofaces, i, axis=1)) for i in range(corners)]
        signs = [np.full(count, (-1) ** i, np.int8) for i in range(corners)]
        rows = np.tile(np.arange(count), corners)
        shape = (count, len(self.simplices[order]))
        return csr_matrix((np.concatenate(signs), (rows, np.concatenate(columns))), shape=shape)


@dataclass(frozen=True)
class OrientedEdges:
    """The simple graph behind measured edges: `edges (N, 2)` with i < j, unique and in order.

    Measured edge e lies on row `row[e]`, in its direction where `sign[e]` is +1; a self-loop has row −1.
    """

    edges: Ints
    row: Ints
    sign: Ints

    @property
    def first(self) -> Ints:
        """The first measured edge (N,) of each."""
        real = np.flatnonzero(self.row >= 0)
        return np.asarray(real[np.unique(self.row[real], return_index=True)[1]])

    def pooled(self, omega: Floats, weights: Floats) -> tuple[Floats, Floats]:
        """The weighted mean (N, k) of the 1-form over parallel edges, in the simple graph's direction, and their total
        weight (N,).
        """
        real = self.row >= 0
        row, signed = self.row[real], (self.sign[:, None] * omega)[real]
        total: Floats = np.bincount(row, weights[real], minlength=len(self.edges)).astype(float)
        spread = csr_matrix((weights[real], (row, np.arange(len(row)))), shape=(len(self.edges), len(row)))
        return np.asarray((spread @ signed) / np.where(total > 0, total, 1.0)[:, None]), total


def orient_edges(edges: Ints, vertex_count: int) -> OrientedEdges:
    """The simple, oriented graph of measured edges (E, 2): parallel edges become one, self-loops none."""
    edges = np.asarray(edges, np.int64).reshape(-1, 2)
    check_edges(edges, vertex_count)
    real = edges[:, 0] != edges[:, 1]
    low, high = edges.min(axis=1), edges.max(axis=1)
    keys, inverse = np.unique((low * vertex_count + high)[real], return_inverse=True)
    row = np.full(len(edges), -1, np.int64)
    row[real] = inverse
    simple = np.stack([keys // max(vertex_count, 1), keys % max(vertex_count, 1)], axis=1)
    return OrientedEdges(simple, row, np.where(edges[:, 0] <= edges[:, 1], 1, -1))


def flag_complex(edges: Ints, vertex_count: int) -> SimplicialComplex:
    """Every clique of up to three vertices (Section 4). Parallel edges count once, self-loops not at all.

    Raises `GraphError` before it would list more than 50 million triangles; `clique_counts` says how many.
    The last complexes are kept: the stages of a round, which ask for that of the same graph, share one.
    """
    return _cliques(orient_edges(edges, vertex_count).edges.tobytes(), vertex_count)


@lru_cache(maxsize=2)
def _cliques(pairs: bytes, vertex_count: int) -> SimplicialComplex:
    simple = np.frombuffer(pairs, np.int64).reshape(-1, 2)
    search = _TriangleSearch(simple, vertex_count)
    parts, found = [np.zeros((0, 3), np.int64)], 0
    for part in search.triangles():
        found += len(part)
        if found > MOST_LISTED:
            raise GraphError(f"the graph has more than {MOST_LISTED} triangles: thin out its edges")
        parts.append(part)
    triangles = np.sort(search.vertex_of_rank[np.concatenate(parts)], axis=1)
    triangles = triangles[np.lexsort(triangles.T[::-1])]
    vertices = np.arange(vertex_count, dtype=np.int64)[:, None]
    vertices.flags.writeable = triangles.flags.writeable = False
    return SimplicialComplex((vertices, simple, triangles))


def clique_counts(edges: Ints, vertex_count: int) -> tuple[int, int, int]:
    """How many vertices, edges and triangles the flag complex has; triangles are counted without being kept."""
    simple = orient_edges(edges, vertex_count).edges
    return vertex_count, len(simple), sum(map(len, _TriangleSearch(simple, vertex_count).triangles()))


class _TriangleSearch:
    """Triangles in the order of vertex degree: a vertex has at most √(2E) neighbours of higher rank."""

    def __init__(self, edges: Ints, vertex_count: int) -> None:
        degree = np.bincount(edges.ravel(), minlength=vertex_count)
        self.vertex_of_rank = np.argsort(degree, kind="stable")
        rank = np.empty(vertex_count, np.int64)
        rank[self.vertex_of_rank] = np.arange(vertex_count)
        ranked = np.sort(rank[edges], axis=1)
        self.count = vertex_count
        self.keys = np.sort(ranked[:, 0] * vertex_count + ranked[:, 1])
        self.edges: Ints = np.stack([self.keys // max(vertex_count, 1), self.keys % max(vertex_count, 1)], 1)
        self.offsets = np.searchsorted(self.edges[:, 0], np.arange(vertex_count + 1))

    def triangles(self) -> Iterator[Ints]:
        """The triangles (N, 3) by ascending ranks, in bounded batches: each edge with a vertex of higher rank."""
        last = self.edges[:, 1]
        candidates = self.offsets[last + 1] - self.offsets[last]
        ends = np.cumsum(candidates)
        start = 0
        while start < len(last):
            before = int(ends[start - 1]) if start else 0
            stop = max(start + 1, int(np.searchsorted(ends, before + CANDIDATES_AT_ONCE, side="right")))
            yield self._extended(self.edges[start:stop], candidates[start:stop])
            start = stop

    def _extended(self, edges: Ints, candidates: Ints) -> Ints:
        row = np.repeat(np.arange(len(edges)), candidates)
        within = np.arange(len(row)) - np.repeat(np.cumsum(candidates) - candidates, candidates)
        new = self.edges[self.offsets[edges[row, 1]] + within, 1]
        wanted = edges[row, 0] * self.count + new
        joined = self.keys[np.minimum(np.searchsorted(self.keys, wanted), len(self.keys) - 1)] == wanted
        return np.concatenate([edges[row[joined]], new[joined, None]], axis=1)


def nerve(flag: SimplicialComplex, occupancy: csr_matrix) -> SimplicialComplex:
    """The complex of Definition 1: triangles only where the three clouds share a voxel.

    Vertices and edges are the viewing graph's and stay as they are.
    """
    vertices, edges, triangles = flag.simplices
    kept = [np.zeros(0, bool)]
    for start in range(0, len(triangles), SIMPLICES_AT_ONCE):
        a, b, c = triangles[start : start + SIMPLICES_AT_ONCE].T
        common = occupancy[a].multiply(occupancy[b]).tocsr().multiply(occupancy[c]).tocsr()
        kept.append(common.getnnz(axis=1) > 0)
    return SimplicialComplex((vertices, edges, triangles[np.concatenate(kept)]))
