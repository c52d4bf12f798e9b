"""Graphs whose wrong edges are known."""

from __future__ import annotations

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.types import Bools, Floats, Ints, ViewGraph

SIGMA = np.repeat([0.005, 0.01], 3)


def poses_on_a_ring(count: int, seed: int = 0) -> Floats:
    """Views 3 m from the middle of a room, looking outwards, a little up or down."""
    rng = np.random.default_rng(seed)
    angle = 2 * np.pi * np.arange(count) / count
    turn = se3.so3_exp(np.outer(angle, [0, 0, 1])) @ se3.so3_exp(rng.normal(0, 0.1, (count, 3)))
    return se3.from_parts(turn, np.stack([3 * np.cos(angle), 3 * np.sin(angle), rng.normal(0, 0.2, count)], axis=1))


def near_pairs(count: int, reach: int) -> Ints:
    """Each view of a ring with the next `reach` ones."""
    k = np.arange(count)
    return np.concatenate([np.stack([k, (k + step) % count], axis=1) for step in range(1, reach + 1)])


def measured(poses: Floats, edges: Ints, seed: int = 0, noise: float = 1.0) -> ViewGraph:
    """A graph of these pairs with noise of 0.3 degrees and 1 cm an axis, times `noise`."""
    xi = noise * SIGMA * np.random.default_rng(seed).normal(size=(len(edges), 6))
    motion = se3.inverse(poses[edges[:, 0]]) @ poses[edges[:, 1]] @ se3.exp(xi)
    return ViewGraph.from_edges(np.arange(len(poses)), edges, motion)


def spoiled(graph: ViewGraph, rows: Ints, seed: int = 0) -> tuple[ViewGraph, Bools]:
    """The graph with random motions in these edges, and where its edges are right."""
    rng = np.random.default_rng(seed)
    motion = graph.i_from_j.copy()
    motion[rows] = se3.exp(np.concatenate([rng.normal(0, 1.5, (len(rows), 3)), rng.normal(0, 3, (len(rows), 3))], 1))
    right = np.ones(graph.edge_count, bool)
    right[rows] = False
    return ViewGraph.from_edges(graph.vertex_ids, graph.edges, motion), right
