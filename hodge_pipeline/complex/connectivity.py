"""The vertex connectivity of a graph: Algorithm 1 needs a 3-connected one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from hodge_pipeline.complex.cech import orient_edges
from hodge_pipeline.types import Bools, Ints

MOST_STEPS = 2_000_000

Neighbours: TypeAlias = list[list[tuple[int, int]]]
"""For each vertex, its (neighbour, edge row) pairs."""


@dataclass(frozen=True)
class Connectivity:
    """What a graph loses when an edge or a vertex goes.

    - `bridges`: edge rows without which a component falls apart; no loop passes them, so no solver can test them.
    - `cut_vertices`: vertex rows without which a component falls apart.
    - `least_degree`: the fewest different neighbours of any vertex.
    - `three_connected`: whether the graph stays in one piece when any two vertices go; None where it meets the
      necessary conditions above, but the full test would take more than 2 million steps (V × E).
    """

    bridges: Ints
    cut_vertices: Ints
    least_degree: int
    three_connected: bool | None


def connectivity(edges: Ints, vertex_count: int) -> Connectivity:
    """Bridges, cut vertices and, where it is affordable or already refuted, 3-connectedness. Linear but for that."""
    edges = np.asarray(edges, np.int64).reshape(-1, 2)
    oriented = orient_edges(edges, vertex_count)
    neighbours = _adjacency(oriented.edges, vertex_count)
    low_bridges, cut, pieces = _lowpoints(neighbours, len(oriented.edges), None)
    # an edge that has a parallel one is no bridge
    repeats = np.bincount(oriented.row[oriented.row >= 0], minlength=len(oriented.edges))
    is_bridge = low_bridges & (repeats == 1)
    bridges = np.flatnonzero((oriented.row >= 0) & is_bridge[oriented.row]) if len(is_bridge) else np.zeros(0, np.int64)
    degree = np.bincount(oriented.edges.ravel(), minlength=vertex_count)
    least = int(degree.min()) if vertex_count else 0
    three: bool | None = vertex_count >= 4 and pieces == 1 and not cut.any() and least >= 3
    if three:
        affordable = vertex_count * len(oriented.edges) <= MOST_STEPS
        three = _survives_any_vertex(neighbours, len(oriented.edges)) if affordable else None
    return Connectivity(bridges, np.flatnonzero(cut), least, three)


def _survives_any_vertex(neighbours: Neighbours, edge_count: int) -> bool:
    """Whether the graph without any one vertex is connected and has no cut vertex."""
    for gone in range(len(neighbours)):
        _, cut, pieces = _lowpoints(neighbours, edge_count, gone)
        if pieces > 1 or cut.any():
            return False
    return True


def _lowpoints(neighbours: Neighbours, edge_count: int, gone: int | None) -> tuple[Bools, Bools, int]:
    """Which edges are bridges and which vertices cut, and the number of pieces, by one depth-first search (Tarjan).

    The graph is simple; the vertex `gone` is left out.
    """
    vertex_count = len(neighbours)
    order = [-1] * vertex_count
    low = [0] * vertex_count
    bridge, cut = np.zeros(edge_count, bool), np.zeros(vertex_count, bool)
    if gone is not None:
        order[gone] = vertex_count  # later than any: never entered, never the lowest
    clock = pieces = 0
    for root in range(vertex_count):
        if order[root] >= 0:
            continue
        pieces += 1
        order[root] = low[root] = clock
        clock += 1
        root_children = 0
        stack = [(root, -1, iter(neighbours[root]))]
        while stack:
            vertex, edge_above, rest = stack[-1]
            for other, edge in rest:
                if order[other] < 0:
                    order[other] = low[other] = clock
                    clock += 1
                    root_children += vertex == root
                    stack.append((other, edge, iter(neighbours[other])))
                    break
                if edge != edge_above and order[other] < low[vertex]:
                    low[vertex] = order[other]
            else:
                stack.pop()
                if stack:
                    above = stack[-1][0]
                    low[above] = min(low[above], low[vertex])
                    bridge[edge_above] = low[vertex] > order[above]
                    if above != root and low[vertex] >= order[above]:
                        cut[above] = True
        cut[root] = root_children > 1
    return bridge, cut, pieces


def _adjacency(edges: Ints, vertex_count: int) -> Neighbours:
    neighbours: Neighbours = [[] for _ in range(vertex_count)]
    for row, (i, j) in enumerate(edges.tolist()):
        neighbours[i].append((j, row))
        neighbours[j].append((i, row))
    return neighbours
