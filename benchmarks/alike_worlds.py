"""Worlds whose parts look alike: storeys, decks of a car park and rows of a field, of which loops take one for another.

All wrong loops of a world share one shift of the world, and each agrees with the others wherever they are.
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
from hodge_pipeline.types import Bools, Floats, ViewGraph

STOREY_M, ROW_M = 3.0, 1.5
NOISES = ((0.001, 0.005), (0.002, 0.02))
"""Standard deviations of a step, radians and metres; loops err twice as much."""
STATED = (0.5, 1.0, 3.0)
"""Factors from standard deviations to stated ones."""


def alike_cases(seed: int) -> Iterator[Case]:
    """Walks with a loop in three steps, or one a step, 30 to 70 % of which take a part of the world for the next."""
    worlds = ("storeys", "one lap a storey", "deck", "rows")
    kinds = itertools.product((3, 1), worlds, (0.3, 0.5, 0.7), NOISES, STATED)
    for number, (every, kind, wrong, noise, stated) in enumerate(kinds):
        rng = np.random.default_rng([seed, number])
        poses = _deck(rng) if kind == "deck" else _rows(rng) if kind == "rows" else _storeys(kind == "storeys", rng)
        name = f"{kind}, {wrong:.0%} wrong, {noise[1]} m a step, stated × {stated}"
        name += ", a loop a step" if every == 1 else ""
        yield _case(name, poses, len(poses) // every, wrong, noise, stated, rng)


def _storeys(twice: bool, rng: np.random.Generator) -> Floats:
    """Two to four storeys, each walked round once or twice, and the stairs between them."""
    floors, steps = int(rng.integers(2, 5)), int(rng.integers(50, 110))
    along = np.tile(np.linspace(0, 60, steps, endpoint=False), 1 + twice)
    corners = np.array([0, 20, 30, 50, 60])
    x, y = np.interp(along, corners, [0, 20, 20, 0, 0]), np.interp(along, corners, [0, 0, 10, 10, 0])
    yaw = np.searchsorted(corners, along, side="right") * np.pi / 2
    lap = np.stack([x, y, 0 * x], axis=1)
    up = np.linspace(0, 1, 8)[1:-1]
    stairs = np.stack([-3 * np.sin(np.pi * up), 0 * up, STOREY_M * up], axis=1)
    places = np.concatenate([np.concatenate([lap, stairs]) + [0, 0, STOREY_M * floor] for floor in range(floors)])
    yaws = np.tile(np.concatenate([yaw, np.full(len(stairs), np.pi / 2)]), floors)
    return _upright(places[: -len(stairs)], yaws[: -len(stairs)])


def _deck(rng: np.random.Generator) -> Floats:
    """Three to five turns of a helix."""
    turns, steps = int(rng.integers(3, 6)), int(rng.integers(50, 110))
    yaw = 2 * np.pi * np.arange(turns * steps) / steps
    return _upright(np.stack([10 * np.sin(yaw), -10 * np.cos(yaw), STOREY_M * yaw / (2 * np.pi)], axis=1), yaw)


def _rows(rng: np.random.Generator) -> Floats:
    """Six to thirteen rows of a field, walked to and fro."""
    rows, steps = int(rng.integers(6, 14)), int(rng.integers(20, 40))
    row, along = np.divmod(np.arange(rows * steps), steps)
    x = 0.5 * np.where(row % 2, steps - 1 - along, along)
    return _upright(np.stack([x, ROW_M * row, 0 * x], axis=1), np.pi * (row % 2))


def _upright(places: Floats, yaw: Floats) -> Floats:
    return np.asarray(se3.from_parts(se3.so3_exp(np.outer(yaw, [0.0, 0.0, 1.0])), places))


def _case(
    name: str,
    poses: Floats,
    loops: int,
    wrong: float,
    noise: tuple[float, float],
    stated: float,
    rng: np.random.Generator,
) -> Case:
    places, count = poses[:, :3, 3], len(poses)
    shift = np.array([0, ROW_M, 0]) if name.startswith("rows") else np.array([0, 0, STOREY_M])
    i, j = np.triu_indices(count, 15)
    apart = places[j] - places[i]
    is_wrong = np.linalg.norm(apart - shift, axis=1) < 1.5
    is_right = (np.linalg.norm(apart, axis=1) < 1.5) if name.startswith(("storeys", "one")) else is_wrong.copy()
    if name.startswith("rows"):  # the row after the next one is taken for the next
        is_wrong = np.linalg.norm(apart - 2 * shift, axis=1) < 1.0
    good, bad = (_some(each, round(share * loops), rng) for each, share in ((is_right, 1 - wrong), (is_wrong, wrong)))
    edges = np.concatenate([np.stack([np.arange(count - 1), np.arange(1, count)]), np.stack([i, j])[:, good]], axis=1)
    edges = np.concatenate([edges, np.stack([i, j])[:, bad]], axis=1).T
    right = np.arange(len(edges)) < len(edges) - len(bad)
    seen = poses[edges[:, 1]].copy()
    seen[~right, :3, 3] -= shift
    sigma = np.repeat(noise, 3) * np.where(np.arange(len(edges)) < count - 1, 1.0, 2.0)[:, None]
    motion = se3.inverse(poses[edges[:, 0]]) @ seen @ se3.exp(rng.normal(size=sigma.shape) * sigma)
    information = np.eye(6) / (stated * sigma[:, None, :]) ** 2
    return Case(name, ViewGraph.from_edges(np.arange(count), edges, motion, information=information), places, right)


def _some(among: Bools, count: int, rng: np.random.Generator) -> Floats:
    rows = np.flatnonzero(among)
    return np.asarray(rng.choice(rows, min(count, len(rows)), replace=False))
