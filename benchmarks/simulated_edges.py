"""Simulated viewing graphs whose wrong edges are known: rings, corridors and streets of some 30 to 90 views."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.types import Bools, Floats, Ints, ViewGraph

SIGMA = np.repeat([0.01, 0.02], 3)
KINDS = ("ring", "corridor", "street")
SEEN_M = 1.5
"""Views nearer to each other may be joined by a loop."""
RIGHT_SIGMAS = 10.0
"""An edge that is further off on an axis is wrong, be it an error in the tail of Student's t."""
WRONG_SHARES = (0.0, 0.1, 0.3, 0.5, 0.7, 0.9)


def simulated(seed: int, wrong: float | None = None, heavy_tails: bool | None = None) -> tuple[str, ViewGraph, Bools]:
    """The kind, a graph of 30 to 90 views and where (E,) its edges are right; `wrong`: the share of wrong ones,
    `heavy_tails`: whether errors are Student's t and not Gaussian, both drawn where None.

    Drawn by the seed: dense or sparse, errors of either kind, wrong edges at random or in groups that agree.
    """
    rng = np.random.default_rng(seed)
    kind = KINDS[seed % len(KINDS)]
    poses = _walk(kind, int(rng.integers(30, 90)), rng)
    pairs = _right_pairs(poses, int(rng.integers(1, 5)), float(rng.uniform(0.3, 4)), rng)
    drawn = bool(rng.integers(2))
    is_heavy = drawn if heavy_tails is None else heavy_tails
    errors = rng.standard_t(4, (len(pairs), 6)) if is_heavy else rng.normal(size=(len(pairs), 6))
    motions = between(poses, pairs) @ se3.exp(errors * SIGMA)
    share = float(rng.choice(WRONG_SHARES)) if wrong is None else wrong
    count = int(share / (1 - share) * len(pairs))
    more, bad = _groups(poses, count, rng) if rng.integers(2) else _random(poses, count, rng)
    edges, motion = np.concatenate([pairs, more]), np.concatenate([motions, bad])
    off = np.abs(se3.log(se3.inverse(motion) @ between(poses, edges)))
    right = (off < RIGHT_SIGMAS * SIGMA).all(axis=1)
    return kind, ViewGraph.from_edges(np.arange(len(poses)), edges, motion), np.asarray(right)


def several(
    seeds: range, wrong: float | None = None, heavy_tails: bool | None = None
) -> Iterator[tuple[str, ViewGraph, Bools]]:
    """One graph for each seed."""
    return (simulated(seed, wrong, heavy_tails) for seed in seeds)


def _walk(kind: str, count: int, rng: np.random.Generator) -> Floats:
    """Poses (count, 4, 4): round a room, along a corridor and back, through a town of blocks of 8 m."""
    k = np.arange(count)
    if kind == "ring":
        yaw = 2 * np.pi * k / count
        place = 3 * np.stack([np.cos(yaw), np.sin(yaw)], axis=1)
    elif kind == "corridor":
        yaw = np.where(k < count // 2, 0.0, np.pi)
        place = np.stack([0.5 * np.where(k < count // 2, k, count - k), rng.normal(0, 0.3, count)], axis=1)
    else:
        yaw = np.pi / 2 * np.cumsum(np.where(k % 8 == 0, rng.integers(-1, 2, count), 0))
        place = np.cumsum(np.stack([np.cos(yaw), np.sin(yaw)], axis=1), axis=0)
    turn = se3.so3_exp(np.outer(yaw, [0, 0, 1])) @ se3.so3_exp(rng.normal(0, 0.08, (count, 3)))
    return se3.from_parts(turn, np.column_stack([place, rng.normal(0, 0.1, count)]))


def _right_pairs(poses: Floats, reach: int, loops: float, rng: np.random.Generator) -> Ints:
    """Each view with the next `reach` ones, and `loops` a view between views that come near each other."""
    count = len(poses)
    i, j = np.triu_indices(count, 1)
    near = np.linalg.norm(poses[i, :3, 3] - poses[j, :3, 3], axis=1) < SEEN_M
    loop = np.flatnonzero(near & (j - i > reach))
    loop = rng.choice(loop, min(len(loop), int(loops * count)), replace=False)
    chosen = np.concatenate([np.flatnonzero(j - i <= reach), loop])
    return np.stack([i, j], axis=1)[chosen]


def between(poses: Floats, pairs: Ints) -> Floats:
    return np.asarray(se3.inverse(poses[pairs[:, 0]]) @ poses[pairs[:, 1]])


def _random(poses: Floats, count: int, rng: np.random.Generator) -> tuple[Ints, Floats]:
    """Random pairs with the motions of other pairs, turned on by some 40°."""
    pairs, other = rng.integers(0, len(poses), (2, count, 2))
    turned = se3.exp(np.concatenate([rng.normal(0, 0.7, (count, 3)), np.zeros((count, 3))], axis=1))
    proper = pairs[:, 0] != pairs[:, 1]
    return pairs[proper], (between(poses, other) @ turned)[proper]


def _groups(poses: Floats, count: int, rng: np.random.Generator) -> tuple[Ints, Floats]:
    """Groups of ten between two places that look alike: all have the place of the one mistaken for the other."""
    pairs, motions = [np.zeros((0, 2), np.int64)], [np.zeros((0, 4, 4))]
    for _ in range(-(-count // 10)):
        first, second = rng.choice(len(poses), 2, replace=False)
        mistaken = poses[first] @ se3.exp(rng.normal(0, 0.3, (1, 6)))[0] @ se3.inverse(poses[second])
        pair = np.clip(np.array([first, second]) + rng.integers(-4, 5, (10, 2)), 0, len(poses) - 1)
        pair = pair[pair[:, 0] != pair[:, 1]]
        errors = se3.exp(SIGMA * rng.normal(size=(len(pair), 6)))
        pairs.append(pair)
        motions.append(se3.inverse(poses[pair[:, 0]]) @ mistaken @ poses[pair[:, 1]] @ errors)
    return np.concatenate(pairs), np.concatenate(motions)
