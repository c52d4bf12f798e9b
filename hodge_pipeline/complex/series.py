"""Edges in series: those that exactly the same cycles pass, so that no cycle distinguishes them."""

from __future__ import annotations

import numpy as np

from hodge_pipeline.complex.cycles import spanning_forest
from hodge_pipeline.types import Ints


def series_classes(edges: Ints, vertex_count: int) -> Ints:
    """The class (E,) of each edge: equal numbers where the same cycles pass, −1 where none does.

    A self-loop is a class of its own. Each chord of a spanning tree gets a random number of 64 bits, and each edge the
    exclusive or of those whose fundamental cycles pass it: equal for edges in series, and for others but by a chance of
    2⁻⁶⁴ (the cycle space sampling of Pritchard and Thurimella 2011).
    """
    forest = spanning_forest(edges, vertex_count)
    label = np.zeros(len(edges), np.uint64)
    label[forest.chords] = np.random.default_rng(0).integers(1, 2**64, len(forest.chords), np.uint64)
    below = np.zeros(vertex_count, np.uint64)
    proper = forest.chords[edges[forest.chords, 0] != edges[forest.chords, 1]]
    np.bitwise_xor.at(below, edges[proper].ravel(), np.repeat(label[proper], 2))
    total, parent = below.tolist(), forest.parent.tolist()
    for vertex in np.argsort(-forest.depth, kind="stable").tolist():
        if parent[vertex] >= 0:
            total[parent[vertex]] ^= total[vertex]
    child = np.flatnonzero(forest.parent >= 0)
    label[forest.parent_edge[child]] = np.array(total, np.uint64)[child]
    classes = np.unique(label, return_inverse=True)[1].reshape(-1)
    return np.where(label == 0, -1, classes)
