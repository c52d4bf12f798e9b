"""Algorithm 2: the 1-form on the surface's diagonals, its integrals along shortest paths of the graph (Eq. (5))."""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra

from hodge_paper.embedding import Surface
from hodge_pipeline.errors import GraphError
from hodge_pipeline.types import Bools, Floats, Ints

CELLS_AT_ONCE = 8_000_000  # of the table (sources, vertices): about 100 MB with distances
FIRST_RADIUS = 4.0  # edges; diagonals of small cells need no more


class _Lookup:
    """The first edge between each pair of joined vertices."""

    def __init__(self, edges: Ints, vertex_count: int) -> None:
        self.count = vertex_count
        key = edges.min(axis=1) * vertex_count + edges.max(axis=1)
        order = np.argsort(key, kind="stable")
        order = order[(edges[:, 0] != edges[:, 1])[order]]
        self.keys, first = np.unique(key[order], return_index=True)
        self.edge = order[first]
        self.forward = edges[self.edge, 0] == edges[self.edge].min(axis=1)
        low, high = self.keys // max(vertex_count, 1), self.keys % max(vertex_count, 1)
        self.adjacency = csr_matrix((np.ones(len(low)), (low, high)), shape=(vertex_count, vertex_count))

    def find(self, a: Ints, b: Ints) -> tuple[Ints, Ints]:
        """The edge (N,) that joins a and b, −1 where none does, and +1 where it runs from a to b."""
        wanted = np.minimum(a, b) * self.count + np.maximum(a, b)
        place = np.minimum(np.searchsorted(self.keys, wanted), len(self.keys) - 1)
        edge = np.where(self.keys[place] == wanted, self.edge[place], -1)
        return edge, np.where((a < b) == self.forward[place], 1, -1)


def surface_form(surface: Surface, omega: Floats) -> Floats:
    """ω (E + D, k) on every edge of the surface, from ω (E, k) on the graph's (Algorithm 2, Eq. (5)).

    A diagonal gets the sum of ω along a path of the graph with the fewest edges. One that joins a vertex to itself gets
    0, one parallel to an edge that edge's ω (of several, the first). Where paths tie, the vertices' order decides.
    """
    count = surface.graph_edge_count
    if omega.shape[0] != count:
        raise GraphError(f"ω has {omega.shape[0]} rows, but the embedded graph has {count} edges")
    graph_edges, diagonals = surface.edges[:count], surface.edges[count:]
    return np.concatenate([omega, path_integrals(graph_edges, surface.vertex_count, omega, diagonals)])


def path_integrals(edges: Ints, vertex_count: int, omega: Floats, pairs: Ints) -> Floats:
    """Σ ω (N, k) along a path of fewest edges from `pairs[:, 0]` to `pairs[:, 1]`; 0 from a vertex to itself.

    Joined vertices take the edge between them. Searches start small and widen, by batches of sources. Raises
    `GraphError` where no path joins a pair.
    """
    out = np.zeros((len(pairs), omega.shape[1]))
    apart = np.flatnonzero(pairs[:, 0] != pairs[:, 1])
    if len(apart) == 0:
        return out
    lookup = _Lookup(edges, vertex_count)
    edge, sign = lookup.find(pairs[apart, 0], pairs[apart, 1])
    joined = edge >= 0
    out[apart[joined]] = sign[joined, None] * omega[edge[joined]]
    open_rows, radius = apart[~joined], FIRST_RADIUS
    while len(open_rows):
        reached = _integrate_within(lookup, omega, pairs[open_rows], radius, out, open_rows)
        open_rows = open_rows[~reached]
        if len(open_rows) and np.isinf(radius):
            a, b = pairs[open_rows[0]]
            raise GraphError(f"no path joins vertex rows {a} and {b}, yet an edge of the surface does")
        radius = np.inf if radius > len(edges) else radius * 4
    return out


def _integrate_within(lookup: _Lookup, omega: Floats, pairs: Ints, radius: float, out: Floats, out_rows: Ints) -> Bools:
    """Fills the rows of `out` whose pair is joined by a path within the radius; says which (N,)."""
    sources, source_of = np.unique(pairs[:, 0], return_inverse=True)
    order = np.argsort(source_of, kind="stable")
    starts = np.searchsorted(source_of[order], np.arange(len(sources) + 1))
    reached = np.zeros(len(pairs), bool)
    batch = max(1, CELLS_AT_ONCE // lookup.count)
    for first in range(0, len(sources), batch):
        last = min(first + batch, len(sources))
        _, parents = dijkstra(
            lookup.adjacency, directed=False, indices=sources[first:last], return_predecessors=True, limit=radius
        )
        rows = order[starts[first] : starts[last]]
        table_row, vertex = source_of[rows] - first, pairs[rows, 1].copy()
        active = np.flatnonzero(parents[table_row, vertex] >= 0)
        reached[rows[active]] = True
        while len(active):
            above = parents[table_row[active], vertex[active]].astype(np.int64)
            edge, sign = lookup.find(above, vertex[active])
            out[out_rows[rows[active]]] += sign[:, None] * omega[edge]
            vertex[active] = above
            active = active[parents[table_row[active], above] >= 0]
    return reached
