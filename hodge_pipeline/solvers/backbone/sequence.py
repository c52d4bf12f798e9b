"""Which edges of a graph follow each other, as those of an odometry do."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hodge_pipeline.solvers.backbone.levels import NEARLY_ALL
from hodge_pipeline.types import Bools, Ints, ViewGraph


def consecutive_edges(graph: ViewGraph) -> Bools:
    """Which edges (E,) join vertices that follow each other in the order of their ids."""
    return np.asarray(steps_apart(graph) == 1)


def steps_apart(graph: ViewGraph) -> Ints:
    """The distance (E,) of the vertices of each edge in the order of their ids."""
    return np.asarray(np.abs(np.diff(vertex_ranks(graph)[graph.edges], axis=1)[:, 0]))


def vertex_ranks(graph: ViewGraph) -> Ints:
    """The rank (V,) of each vertex by its id where ids are numbers, else its row."""
    if graph.vertex_ids.dtype.kind in "iu":
        return np.argsort(np.argsort(graph.vertex_ids, kind="stable"), kind="stable")
    return np.arange(graph.vertex_count)


def sequential_edges(graph: ViewGraph) -> Bools:
    """Which edges (E,) are consecutive, only the first of parallel ones."""
    out, rows = np.zeros(graph.edge_count, bool), np.flatnonzero(consecutive_edges(graph))
    out[rows[np.unique(np.sort(graph.edges[rows], axis=1), axis=0, return_index=True)[1]]] = True
    return out


def numbered_along_path(graph: ViewGraph) -> ViewGraph:
    """The graph with other vertex ids where its own tell no sequence and the order of its edges does: as SLAM writes a
    graph, each new vertex is reached from the last one of its path, by whatever ids.
    """
    count = graph.vertex_count
    if sequential_edges(graph).sum() >= NEARLY_ALL * count:
        return graph
    path, paths = [-1] * count, list[list[int]]()
    for a, b in graph.edges.tolist():
        old, new = (b, a) if path[b] >= 0 else (a, b)
        if path[new] >= 0 or old == new:
            continue
        if path[old] < 0:
            path[old] = len(paths)
            paths.append([old])
        along = paths[path[old]]
        if len(along) == 2 and along[0] == old:  # its first edge was written the other way round
            along.reverse()
        if along[-1] != old:
            path[new] = len(paths)
            paths.append([new])
        else:
            path[new] = path[old]
            along.append(new)
    if sum(map(len, paths)) - len(paths) < NEARLY_ALL * count:
        return graph
    numbers = np.empty(count, np.int64)
    order = [vertex for each in paths for vertex in each] + [row for row in range(count) if path[row] < 0]
    numbers[order] = np.arange(count)
    return replace(graph, vertex_ids=numbers)


def linear_forest(edges: Ints, count: int, trusted: Bools) -> Bools:
    """Trusted edges (E,) that form paths: a linear forest, chosen greedily, edges between near vertex rows first."""
    rows = np.flatnonzero(trusted & (edges[:, 0] != edges[:, 1]))
    rows = rows[np.argsort(np.abs(edges[rows, 0] - edges[rows, 1]), kind="stable")]
    degree, root = [0] * count, list(range(count))

    def find(vertex: int) -> int:
        while root[vertex] != vertex:
            root[vertex] = root[root[vertex]]
            vertex = root[vertex]
        return vertex

    out = np.zeros(len(edges), bool)
    for row, (i, j) in zip(rows.tolist(), edges[rows].tolist(), strict=True):
        if degree[i] < 2 and degree[j] < 2 and (a := find(i)) != (b := find(j)):
            degree[i], degree[j], root[a] = degree[i] + 1, degree[j] + 1, b
            out[row] = True
    return out
