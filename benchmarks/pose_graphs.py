"""Modelled pose graphs of any size: a cylinder, trajectories, a lattice, a noisy sphere."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.types import Floats, Ints, ViewGraph


def cylinder(count: int) -> tuple[Floats, Ints]:
    """Rings of 100 poses, each joined to the ring below twice: loops everywhere."""
    k = np.arange(count)
    angle = 2 * np.pi * k / 100
    radius = 100 / (2 * np.pi)
    position = np.stack([radius * np.cos(angle), radius * np.sin(angle), k / 100], axis=1)
    poses = se3.from_parts(se3.so3_exp(np.outer(angle, [0, 0, 1])), position)
    return poses, np.concatenate([np.stack([k[:-s], k[s:]], axis=1) for s in (1, 100, 101)])


def trajectory(count: int) -> tuple[Floats, Ints]:
    """A random walk in a grid of streets, with a loop closure at three in ten returns: like a chain."""
    return _walk(count, 0.3, 1)


def streets(count: int) -> tuple[Floats, Ints]:
    """The same walk with an edge to each of the two visits before: two edges a pose where it is long."""
    return _walk(count, 1.0, 2)


def _walk(count: int, closed: float, visits: int) -> tuple[Floats, Ints]:
    rng = np.random.default_rng(0)
    heading = np.repeat(rng.integers(0, 4, count // 10 + 1), 10)[:count]
    position = np.cumsum(np.array([[1, 0], [0, 1], [-1, 0], [0, -1]])[heading], axis=0)
    turns = se3.so3_exp(np.outer(heading * np.pi / 2, [0, 0, 1]))
    poses = se3.from_parts(turns, np.pad(position, ((0, 0), (0, 1))).astype(float))
    place = position[:, 0] * 10**7 + position[:, 1]
    order = np.argsort(place, kind="stable")
    k = np.arange(count)
    edges = [np.stack([k[:-1], k[1:]], axis=1)]
    for visit in range(1, visits + 1):
        same = place[order[visit:]] == place[order[:-visit]]
        returns = np.stack([order[:-visit], order[visit:]], axis=1)[same]
        edges.append(returns[(returns[:, 1] - returns[:, 0] > 1) & (rng.random(len(returns)) < closed)])
    return poses, np.concatenate(edges)


def sphere(count: int) -> tuple[Floats, Ints]:
    """Rings of 44 poses on a sphere, each joined to the next and to three of the ring above."""
    k = np.arange(count)
    turn, tilt = 2 * np.pi * k / 44, np.pi * (k + 1) / (count + 1)
    position = 50 * np.stack([np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), np.cos(tilt)], axis=1)
    rotation = se3.so3_exp(np.outer(turn, [0, 0, 1])) @ se3.so3_exp(np.outer(tilt, [0, 1, 0]))
    return se3.from_parts(rotation, position), np.concatenate(
        [np.stack([k[:-s], k[s:]], axis=1) for s in (1, 43, 44, 45)]
    )


def chained(graph: ViewGraph) -> Floats:
    """Poses by a walk along the edges from each vertex to the next: a start that leads to a local minimum."""
    steps = graph.i_from_j[np.flatnonzero(graph.edges[:, 1] - graph.edges[:, 0] == 1)]
    poses = [np.eye(4)]
    for step in steps:
        poses.append(poses[-1] @ step)
    return np.stack(poses)


def lattice(count: int) -> tuple[Floats, Ints]:
    """A cube of poses turned at random, each joined to its six neighbours: the worst fill."""
    side = round(count ** (1 / 3))
    k = np.arange(side**3).reshape(side, side, side)
    position = np.stack(np.unravel_index(np.arange(side**3), k.shape), axis=1).astype(float)
    poses = se3.from_parts(se3.so3_exp(np.random.default_rng(1).normal(size=(side**3, 3))), position)
    pairs = [(k.take(range(side - 1), axis), k.take(range(1, side), axis)) for axis in range(3)]
    return poses, np.concatenate([np.stack([a.ravel(), b.ravel()], axis=1) for a, b in pairs])


SHAPES: dict[str, tuple[Callable[[int], tuple[Floats, Ints]], float, float]] = {
    "cylinder": (cylinder, 0.05, 0.1),
    "trajectory": (trajectory, 0.01, 0.02),
    "streets": (streets, 0.01, 0.02),
    "lattice": (lattice, 0.05, 0.1),
    "sphere": (sphere, 0.35, 0.5),
}


def synthetic(shape: str, count: int) -> ViewGraph:
    """A modelled graph with noise of this many radians and metres an axis."""
    make, sigma_rad, sigma_m = SHAPES[shape]
    poses, edges = make(count)
    sigma = np.repeat([sigma_rad, sigma_m], 3)
    noise = sigma * np.random.default_rng(2).normal(size=(len(edges), 6))
    measured = se3.inverse(poses[edges[:, 0]]) @ poses[edges[:, 1]] @ se3.exp(noise)
    information = np.tile(np.diag(sigma**-2), (len(edges), 1, 1))
    return ViewGraph.from_edges(np.arange(len(poses)), edges, measured, information)


def with_wrong_edges(graph: ViewGraph, share: float) -> tuple[ViewGraph, Ints]:
    """The graph with this share of its edges, none of neighbours in time, replaced by random motions; their rows."""
    rng = np.random.default_rng(3)
    loops = np.flatnonzero(graph.edges[:, 1] - graph.edges[:, 0] != 1)
    wrong = rng.choice(loops, int(share * graph.edge_count), replace=False)
    measured = graph.i_from_j.copy()
    measured[wrong] = se3.exp(rng.normal(size=(len(wrong), 6)) * np.repeat([1.5, 5.0], 3))
    return dataclasses.replace(graph, i_from_j=measured), wrong
