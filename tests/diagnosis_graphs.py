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


def every_pair_tried(
    seed: int, views: int = 50, wrong_steps: float = 0.1, chance: float = 0.1, alike: int = 2
) -> tuple[ViewGraph, Bools, Floats]:
    """A graph as registering all pairs of fragments gives it, where its edges are right, and the true poses.

    Two rounds of a room. Views that see the same place are nearly all joined, with heavy-tailed errors; `chance` of
    the other pairs are joined wrongly; `wrong_steps` of the views slid along a wall when they were joined to the one or
    two before; and `alike` places look like others, so that wrong edges between them agree.
    """
    rng = np.random.default_rng(seed)
    poses = _walk(views, rng)
    i, j = np.triu_indices(views, 1)
    seen = poses[:, :3, 3] + 1.5 * poses[:, :3, 0]
    turned = np.arccos(np.clip((np.einsum("nab,nab->n", poses[i, :3, :3], poses[j, :3, :3]) - 1) / 2, -1, 1))
    likely = 1 / (1 + np.exp(-(6 - 2.5 * np.linalg.norm(seen[i] - seen[j], axis=1) - 2.7 * turned)))
    right = rng.random(len(i)) < np.where(j - i == 1, 0.98, 0.95 * likely)
    errors = rng.standard_t(4, (len(i), 6)) * np.repeat([0.015, 0.02], 3)
    motion = se3.inverse(poses[i]) @ poses[j] @ se3.exp(errors)
    slid = np.flatnonzero(rng.random(views) < wrong_steps)
    crossing = np.isin(j, slid) & (j - i <= 2) & (rng.random(len(i)) < 0.7)
    aside = se3.exp(np.concatenate([rng.normal(0, 0.3, (views, 3)), rng.normal(0, 0.5, (views, 3))], axis=1))
    motion[crossing], made = (motion @ aside[j])[crossing], right.copy()
    right &= ~crossing
    random = ~made & (rng.random(len(i)) < chance)
    for _ in range(alike):
        first, second = rng.choice(views, 2, replace=False)
        world = poses[first] @ se3.exp(rng.normal(0, 0.1, 6)[None])[0] @ se3.inverse(poses[second])
        mistaken = se3.inverse(poses[i]) @ world @ poses[j]
        alike_pair = ~made & (np.abs(i - first) <= 4) & (np.abs(j - second) <= 4) & (rng.random(len(i)) < 0.4)
        motion[alike_pair] = (mistaken @ se3.exp(errors))[alike_pair]
        random, made = random & ~alike_pair, made | alike_pair
    motion[random] = se3.from_parts(
        se3.so3_exp(rng.normal(0, 1.5, (int(random.sum()), 3))), rng.normal(0, 1.5, (int(random.sum()), 3))
    )
    kept = np.flatnonzero(made | random)
    pairs = np.stack([i, j], axis=1)[kept]
    return ViewGraph.from_edges(np.arange(views), pairs, motion[kept]), right[kept], poses


def _walk(views: int, rng: np.random.Generator) -> Floats:
    """Two rounds of a room of 6 by 4 metres at a varying distance from its middle, looking outwards."""
    angle = 4 * np.pi * np.arange(views) / views + rng.normal(0, 0.05, views)
    out = 1 + np.cumsum(rng.normal(0, 0.1, views))
    turn = se3.so3_exp(np.outer(angle + np.cumsum(rng.normal(0, 0.1, views)), [0, 0, 1]))
    turn = turn @ se3.so3_exp(rng.normal(0, 0.15, (views, 3)))
    at = np.stack([3 * out * np.cos(angle), 2 * out * np.sin(angle), rng.normal(0, 0.2, views)], axis=1)
    return se3.from_parts(turn, at)
