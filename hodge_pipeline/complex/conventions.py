"""Whether a graph's motions are inverted: written by the other convention, or between swapped ids."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import minimum_spanning_tree

from hodge_pipeline import se3
from hodge_pipeline.complex.chi2 import residual_twists
from hodge_pipeline.complex.cycles import edge_between, root_from_vertex, spanning_forest
from hodge_pipeline.types import Ints, ViewGraph

NEARER = 4.0
"""Least ratio of the median closing error to that with inverse motions. Of 90 real and 1000 simulated graphs that are
read as they were meant it is at most 2.3; read the other way it is 5 to 12 of Intel, garage, EECS and Duderstadt.
"""
FEWEST_CYCLES = 3
"""The median of fewer is that of one or two cycles, which a single wrong edge decides."""
ROUNDED = 1e-6
"""Share of the median edge length: closing errors below are those of rounded numbers."""


def inverted_notes(graph: ViewGraph) -> tuple[str, ...]:
    """A note if cycles close far better with every motion (E, 4, 4) inverted, by translations, which differ in the
    plane too; else none.
    """
    tree = nearest_tree(graph.edges, graph.vertex_count)
    cycles = np.setdiff1d(np.arange(graph.edge_count), tree)
    if len(cycles) < FEWEST_CYCLES:
        return ()
    inverse = replace(graph, i_from_j=se3.inverse(graph.i_from_j))
    miss_m, inverse_miss_m = (_median_miss_m(read, tree, cycles) for read in (graph, inverse))
    rounding_m = ROUNDED * float(np.median(np.linalg.norm(graph.i_from_j[:, :3, 3], axis=1)))
    if not miss_m > max(NEARER * inverse_miss_m, rounding_m):
        return ()
    return (
        f"the motions look inverted: swap the two ids of each edge if the file holds j from i: half of its "
        f"{len(cycles)} cycles then miss by less than {inverse_miss_m:.2g} m, as read by {miss_m:.2g} m or more",
    )


def nearest_tree(edges: Ints, vertex_count: int) -> Ints:
    """Rows of a spanning forest of the edges (E, 2) between the nearest vertices: of a sequence, its steps."""
    low, high = edges.min(axis=1), edges.max(axis=1)
    apart = np.flatnonzero(low != high)
    first = apart[np.unique(low[apart] * vertex_count + high[apart], return_index=True)[1]]
    size = (vertex_count, vertex_count)
    tree = minimum_spanning_tree(coo_matrix((high[first] - low[first], (low[first], high[first])), size)).tocoo()
    return np.sort(edge_between(edges, vertex_count, tree.row.astype(np.int64), tree.col.astype(np.int64)))


def _median_miss_m(graph: ViewGraph, tree: Ints, cycles: Ints) -> float:
    """The median residual of translation of the edges `cycles` at poses along the tree, metres."""
    poses = root_from_vertex(spanning_forest(graph.edges[tree], graph.vertex_count), graph.i_from_j[tree])
    return float(np.median(np.linalg.norm(residual_twists(graph.select(cycles), poses)[:, 3:], axis=1)))
