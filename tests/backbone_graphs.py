"""Simulated pose graphs as SLAM leaves them: an odometry that drifts, right loops, and wrong ones."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from hodge_pipeline import se3
from hodge_pipeline.solvers.weights import PLANAR_AXES
from hodge_pipeline.types import Bools, Floats, Ints, ViewGraph

STEP, LOOP = (0.003, 0.03), (0.01, 0.1)
"""Standard deviations, radians and metres, of steps of a metre and of loops."""


@dataclass(frozen=True)
class Drive:
    """A graph, its true poses, and which of its edges are right."""

    graph: ViewGraph
    truth: Floats
    right: Bools

    def error_m(self, world_from_cam: Floats) -> float:
        """The position error after a rigid fit."""
        a, b = world_from_cam[:, :3, 3], self.truth[:, :3, 3]
        if self.graph.dimension == 2:
            a, b = a[:, :2], b[:, :2]
        u, _, vt = np.linalg.svd((b - b.mean(0)).T @ (a - a.mean(0)))
        turn = u @ np.diag([1.0] * (len(u) - 1) + [np.sign(np.linalg.det(u @ vt))]) @ vt
        left = (a - a.mean(0)) @ turn.T + b.mean(0) - b
        return float(np.sqrt((left**2).sum(axis=1).mean()))

    def odometry(self) -> Floats:
        """The poses of the steps alone."""
        steps = np.abs(np.diff(self.graph.edges, axis=1)[:, 0]) == 1
        poses = np.tile(np.eye(4), (self.graph.vertex_count, 1, 1))
        rows = np.flatnonzero(steps)[: self.graph.vertex_count - 1]
        for row in rows[np.argsort(self.graph.edges[rows].min(axis=1))]:
            i, j = self.graph.edges[row]
            motion = self.graph.i_from_j[row]
            poses[max(i, j)] = poses[min(i, j)] @ (motion if i < j else se3.inverse(motion))
        return poses


def drive(
    *,
    seed: int = 1,
    count: int = 400,
    dimension: int = 2,
    loops: int = 100,
    wrong: float = 0.5,
    in_groups: bool = False,
    misstated: tuple[float, float] = (1.0, 1.0),
    turned: bool = False,
) -> Drive:
    """Three laps round a ring. `wrong`: share of the loops that join places at random, or in groups of 12 that agree.

    `misstated`: what the stated standard deviations of steps and of loops are too large by; `turned`: every edge is
    written the other way round.
    """
    rng = np.random.default_rng(seed)
    truth = _ring(count, dimension)
    steps = np.stack([np.arange(count - 1), np.arange(1, count)], axis=1)
    near = cKDTree(truth[:, :3, 3]).query_pairs(3.0, output_type="ndarray")
    near = np.sort(near[np.abs(near[:, 0] - near[:, 1]) > 20], axis=1)
    good = near[rng.choice(len(near), round(loops * (1 - wrong)), replace=False)]
    bad, bad_motion = _wrong(rng, truth, loops - len(good), in_groups, dimension)
    edges = np.concatenate([steps, good, bad])
    exact = se3.inverse(truth[edges[:, 0]]) @ truth[edges[:, 1]]
    exact[len(steps) + len(good) :] = bad_motion
    size = np.where(np.arange(len(edges))[:, None] < len(steps), [STEP], [LOOP])
    motion = exact @ se3.exp(_noise(rng, size, dimension))
    stated = size * np.where(np.arange(len(edges)) < len(steps), *misstated)[:, None]
    information = np.zeros((len(edges), 6, 6))
    information[:, range(6), range(6)] = np.repeat(1 / stated**2, 3, axis=1)
    if turned:
        carried = se3.adjoint(se3.inverse(motion))
        information = np.swapaxes(carried, 1, 2) @ information @ carried
        motion, edges = se3.inverse(motion), edges[:, ::-1].copy()
    if dimension == 2:
        information[:, [0, 1, 5]] = information[:, :, [0, 1, 5]] = 0
    graph = ViewGraph.from_edges(np.arange(count), edges, motion, information, dimension=dimension)
    return Drive(graph, truth, np.arange(len(edges)) < len(steps) + len(good))


def _ring(count: int, dimension: int) -> Floats:
    angle = np.linspace(0, 6 * np.pi, count)
    twist = np.zeros((count, 6))
    twist[:, 2] = angle + np.pi / 2
    poses = se3.exp(twist)
    radius = count / (6 * np.pi)
    poses[:, 0, 3], poses[:, 1, 3] = radius * np.cos(angle), radius * np.sin(angle)
    if dimension == 3:
        tilt = np.zeros((count, 6))
        tilt[:, 0], tilt[:, 1] = 0.3 * np.sin(np.arange(count) / 31), 0.2 * np.cos(np.arange(count) / 53)
        poses = poses @ se3.exp(tilt)
        poses[:, 2, 3] = 2 * np.sin(np.arange(count) / 97)
    return poses


def _noise(rng: np.random.Generator, size: Floats, dimension: int) -> Floats:
    xi = np.zeros((len(size), 6))
    axes = PLANAR_AXES if dimension == 2 else np.arange(6)
    xi[:, axes] = (rng.normal(size=(len(size), 6)) * np.repeat(size, 3, axis=1))[:, axes]
    return xi


def _wrong(rng: np.random.Generator, truth: Floats, count: int, in_groups: bool, dimension: int) -> tuple[Ints, Floats]:
    edges: list[tuple[int, int]] = []
    motion: list[Floats] = []
    while len(edges) < count:
        i, j = rng.integers(0, len(truth) - 12, 2)
        if np.linalg.norm(truth[i, :3, 3] - truth[j, :3, 3]) < 10:
            continue
        shift = se3.exp(_noise(rng, np.array([[0.3, 2.0]]), dimension))[0]
        world_from_world = truth[i] @ shift @ se3.inverse(truth[j])
        for k in range(12 if in_groups else 1):
            edges.append((i + k, j + k))
            motion.append(se3.inverse(truth[i + k]) @ world_from_world @ truth[j + k])
    return np.array(edges[:count], np.int64).reshape(-1, 2), np.array(motion[:count]).reshape(-1, 4, 4)
