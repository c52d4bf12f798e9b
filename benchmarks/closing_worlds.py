"""Walks that meet one place again, at their end, and wrong loops drawn as the Vertigo suite draws them.

What the right loops say of the way round is little beside its drift, and the same in all; but they agree, which wrong
ones between places at random do not. A file often states larger errors of turns than there are.
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

FLAT = np.array([0, 0, 1, 1, 1, 0])
TURN_RAD, SHIFT_M, LOOP = 0.01, 0.03, 0.2
"""Standard deviations of a step of 1 m; of a loop as a share of these."""
WRONG = np.repeat([np.radians(10.0), 0.3], 3)
"""Standard deviations of the motions of wrong loops."""
LOCAL, GROUP = 20, 10
"""Most steps that a local wrong loop spans, and wrong loops of a group, which follow each other with one motion."""


def closing_cases(seed: int) -> Iterator[Case]:
    """Rings of 200 or 400 steps with 5 or 26 loops where they end; 20 to 500 wrong ones, anywhere or local, alone, in
    groups, or as if the robot stood still; turns stated once or eight times as large as they are.
    """
    kinds = itertools.product(
        (200, 400), (5, 26), ("anywhere", "local", "groups", "local groups", "still"), (20, 100, 500), (1.0, 8.0)
    )
    for number, (steps, right, kind, wrong, stated) in enumerate(kinds):
        rng = np.random.default_rng([seed, number])
        name = f"ring of {steps}, {right} right, {wrong} wrong {kind}, turns stated × {stated}"
        yield _case(name, steps, right, kind, wrong, stated, rng)


def _case(name: str, steps: int, right: int, kind: str, wrong: int, stated: float, rng: np.random.Generator) -> Case:
    angle = 2 * np.pi * np.arange(steps + right) / steps
    side = steps / (2 * np.pi) * (1 + 0.2 * np.cos(4 * angle))[:, None]
    places = np.pad(side * np.column_stack([np.cos(angle), np.sin(angle)]), ((0, 0), (0, 1)))
    ahead = np.gradient(places, axis=0)
    yaw = np.arctan2(ahead[:, 1], ahead[:, 0])
    poses = se3.from_parts(se3.so3_exp(np.outer(yaw, [0.0, 0.0, 1.0])), places)
    path = np.stack([np.arange(len(poses) - 1), np.arange(1, len(poses))], axis=1)
    again = np.stack([np.arange(right), steps + np.arange(right)], axis=1)
    good = np.concatenate([path, again])
    sigma = np.repeat([TURN_RAD, SHIFT_M], 3) * np.where(np.arange(len(good)) < len(path), 1.0, LOOP)[:, None]
    motions = se3.inverse(poses[good[:, 0]]) @ poses[good[:, 1]] @ se3.exp(rng.normal(size=sigma.shape) * sigma * FLAT)
    pairs, mistaken = _wrong(kind, wrong, len(poses), rng)
    edges, motions = np.concatenate([good, pairs]), np.concatenate([motions, mistaken])
    information = np.eye(6) / (np.repeat([stated * TURN_RAD, SHIFT_M], 3) ** 2)
    graph = ViewGraph.from_edges(
        np.arange(len(poses)), edges, motions, information=np.broadcast_to(information, (len(edges), 6, 6))
    )
    return Case(name, graph, places, np.arange(len(edges)) < len(good))


def _wrong(kind: str, count: int, size: int, rng: np.random.Generator) -> tuple[Ints, Floats]:
    """Wrong loops (N, 2) between `size` poses, and their motions (N, 4, 4)."""
    group = GROUP if kind.endswith("groups") else 1
    first = rng.integers(0, size - group - 2, count // group)
    far = rng.integers(2, LOCAL, len(first)) if kind.startswith("local") else rng.integers(2, size, len(first))
    second = np.minimum(first + far, size - group)
    pairs = (np.stack([np.minimum(first, second - 2), second], axis=1)[:, None] + np.arange(group)[:, None]).reshape(
        -1, 2
    )
    motions = se3.exp(rng.normal(size=(len(first), 6)) * WRONG * FLAT * (kind != "still"))
    return pairs, np.repeat(motions, group, axis=0)
