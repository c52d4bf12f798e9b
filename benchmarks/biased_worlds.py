"""Walks through streets, and flights above them, whose odometry turns too far at each step, as a biased gyroscope does,
or one whose bias drifts.

It turns about the vertical, or nearly so in flight: gravity tells the tilt. Its drift grows with the square of the
path, or of the steps over which a drifting bias remembers, while the information states independent errors.
"""

from __future__ import annotations

import itertools
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))

from spoilt_graphs import Case

from hodge_pipeline import se3
from hodge_pipeline.types import Floats, Ints, ViewGraph

STEP_M, STREET, STREETS = 2.0, 20, 5
"""Length of a step, steps of a street between two corners, and corners in each direction."""
DRIFTING = 899
"""Steps with a bias that drifts."""
TURN_RAD, SHIFT_M = 0.003, 0.03
"""Standard deviations of a step; loops err twice as much."""


def biased_cases(seed: int) -> Iterator[Case]:
    """300 or 900 steps with a bias of up to four standard deviations; 0 to 80 % of the loops wrong."""
    kinds = itertools.product(
        (True, False), (300, 900), (0.3, 1.0, 2.0, 4.0), ((0.0, ""), (0.4, "random")), (0.3, 1.0, 3.0)
    )
    more = itertools.product(
        (True, False), (900,), (1.0, 2.0), ((0.8, "random"), (0.6, "standing"), (0.6, "streets")), (1.0,)
    )
    for number, (flat, steps, bias, (wrong, kind), stated) in enumerate(itertools.chain(kinds, more)):
        rng = np.random.default_rng([seed, number])
        name = f"{'walk' if flat else 'flight'} of {steps}, {bias * TURN_RAD} rad a step too much, {wrong:.0%} {kind}"
        turns = np.full(steps - 1, bias * TURN_RAD)
        yield _case(f"{name} wrong, stated × {stated}", flat, turns, wrong, kind, stated, rng)


def drifting_cases(seed: int) -> Iterator[Case]:
    """900 steps whose headings drift by .5 to 2 rad in all, by a bias that is remembered over 8 to 200 of them; stated
    errors are small; 0 to 80 % of the loops are wrong.
    """
    kinds = itertools.product((True, False), (8, 50, 200), (0.5, 1.0, 2.0), (0.0, 0.5, 0.8))
    for number, (flat, over, drift, wrong) in enumerate(kinds):
        rng = np.random.default_rng([seed, number])
        kept = np.exp(-1 / over)
        turns, drawn = np.zeros(DRIFTING), drift / np.sqrt(2 * over * DRIFTING) * rng.standard_normal(DRIFTING)
        for step in range(DRIFTING):
            turns[step] = kept * turns[step - 1] + np.sqrt(1 - kept**2 if step else 1.0) * drawn[step]
        name = f"{'walk' if flat else 'flight'}, {drift} rad by a bias over {over} steps, {wrong:.0%} wrong"
        yield _case(name, flat, turns, wrong, "random", 0.3, rng)


def _streets(steps: int, rng: np.random.Generator) -> Floats:
    """Poses (n, 4, 4) of a walk that turns at corners at random, never back."""
    at, places, before = rng.integers(0, STREETS, 2), [], np.zeros(2, np.int64)
    while len(places) < steps:
        ways = [way for way in np.array([[1, 0], [-1, 0], [0, 1], [0, -1]]) if (way != -before).any()]
        ways = [way for way in ways if (at + way >= 0).all() and (at + way < STREETS).all()]
        before = ways[rng.integers(len(ways))]
        places += [STEP_M * (STREET * at + step * before) for step in range(STREET)]
        at = at + before
    on_ground = np.array(places[:steps])
    ahead = np.gradient(on_ground, axis=0)
    yaw = np.convolve(np.pad(np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0])), 2, "edge"), np.ones(5) / 5, "valid")
    at_side = on_ground + rng.normal(0, 0.3, on_ground.shape)
    return np.asarray(se3.from_parts(se3.so3_exp(np.outer(yaw, [0.0, 0.0, 1.0])), np.pad(at_side, ((0, 0), (0, 1)))))


def _case(
    name: str, flat: bool, turns: Floats, wrong: float, kind: str, stated: float, rng: np.random.Generator
) -> Case:
    """The case with these turns (n − 1,) too far, in radians."""
    steps = len(turns) + 1
    poses = _streets(steps, rng)
    if not flat:
        tilt = rng.normal(0, 0.1, (steps, 3)).cumsum(axis=0) / 10
        poses = poses @ se3.exp(np.pad(np.stack([tilt[:, 0], tilt[:, 1]], axis=1), ((0, 0), (0, 4))))
        poses[:, 2, 3] += np.interp(np.arange(steps), np.arange(0, steps + 50, 50), rng.uniform(0, 4, steps // 50 + 1))
    free = np.array([0, 0, 1, 1, 1, 0]) if flat else np.ones(6)
    sigma = np.repeat([TURN_RAD, SHIFT_M], 3)
    i, j = np.triu_indices(steps, STREET)
    apart = np.linalg.norm(poses[i, :3, 3] - poses[j, :3, 3], axis=1)
    good = _some(np.flatnonzero(apart < 3.0), steps // 4, rng)
    pairs, motions = np.stack([i, j], axis=1)[good], se3.inverse(poses[i[good]]) @ poses[j[good]]
    mistaken = _mistaken(kind, poses, round(len(good) * wrong / (1 - wrong)), free, rng)
    pairs, motions = np.concatenate([pairs, mistaken[0]]), np.concatenate([motions, mistaken[1]])
    axis = np.array([0, 0, rng.choice([-1, 1])]) + (not flat) * rng.normal(0, 0.2, 3)
    turn = se3.exp(np.outer(turns, np.concatenate([axis / np.linalg.norm(axis), np.zeros(3)])))
    path = np.stack([np.arange(steps - 1), np.arange(1, steps)], axis=1)
    motions = np.concatenate([se3.inverse(poses[:-1]) @ poses[1:] @ turn, motions])
    edges = np.concatenate([path, pairs])
    sigmas = sigma * np.where(np.arange(len(edges)) < steps - 1, 1.0, 2.0)[:, None]
    motions = motions @ se3.exp(rng.normal(size=sigmas.shape) * sigmas * free)
    information = np.eye(6) / (stated * sigmas[:, None, :]) ** 2
    right = np.arange(len(edges)) < steps - 1 + len(good)
    graph = ViewGraph.from_edges(np.arange(steps), edges, motions, information=information)
    return Case(name, graph, poses[:, :3, 3], right)


def _mistaken(kind: str, poses: Floats, count: int, free: Floats, rng: np.random.Generator) -> tuple[Ints, Floats]:
    """Wrong loops (N, 2), (N, 4, 4): places at random, as if the robot stood still, or parts of streets for others."""
    if not count:
        return np.zeros((0, 2), np.int64), np.zeros((0, 4, 4))
    if kind == "streets":
        begin = np.sort(rng.integers(0, len(poses) - STREET, (-(-count // 10), 2)), axis=1)
        begin = begin[np.linalg.norm(np.diff(poses[begin, :3, 3], axis=1)[:, 0], axis=1) > STREET * STEP_M / 2]
        pairs = (begin[:, None] + rng.integers(0, STREET, (len(begin), 10, 1))).reshape(-1, 2)[:count]
        mistaken = np.repeat(poses[begin[:, 0]] @ se3.inverse(poses[begin[:, 1]]), 10, axis=0)[:count]
        return pairs, se3.inverse(poses[pairs[:, 0]]) @ mistaken @ poses[pairs[:, 1]]
    pairs = np.sort(np.stack([rng.choice(len(poses), 2, replace=False) for _ in range(count)]), axis=1)
    pairs = pairs[np.linalg.norm(poses[pairs[:, 0], :3, 3] - poses[pairs[:, 1], :3, 3], axis=1) > STREET]
    spread = np.array([0.1, 0.1, 0.4, 1, 1, 0.3]) * free * (kind != "standing")
    return pairs, se3.exp(rng.normal(size=(len(pairs), 6)) * spread)


def _some(among: Ints, count: int, rng: np.random.Generator) -> Ints:
    return np.asarray(rng.choice(among, min(count, len(among)), replace=False))
