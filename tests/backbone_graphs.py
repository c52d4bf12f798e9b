"""Simulated pose graphs as SLAM leaves them: an odometry that drifts, right loops, and wrong ones."""

from __future__ import annotations

from dataclasses import dataclass, replace

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
    world: str = "ring",
    loops: int = 100,
    wrong: float = 0.5,
    in_groups: bool = False,
    group: int = 12,
    misstated: tuple[float, float] = (1.0, 1.0),
    turned: bool = False,
    short: int = 0,
) -> Drive:
    """Three laps round a ring, or another of `WORLDS`. `wrong`: share of the loops that join places at random, or in
    groups of this size that agree.

    `misstated`: what the stated standard deviations of steps and of loops are too large by; `turned`: every edge is
    written the other way round; `short`: right loops over two to four steps, as exact as these.
    """
    rng = np.random.default_rng(seed)
    truth = _world(rng, world, count, dimension)
    steps = np.stack([np.arange(count - 1), np.arange(1, count)], axis=1)
    near = cKDTree(truth[:, :3, 3]).query_pairs(3.0, output_type="ndarray")
    near = np.sort(near[np.abs(near[:, 0] - near[:, 1]) > 20], axis=1)
    good = near[rng.choice(len(near), min(len(near), round(loops * (1 - wrong))), replace=False)]
    bad, bad_motion = _wrong(rng, truth, round(loops * wrong), group if in_groups else 1, dimension)
    begin = rng.choice(count - 4, short, replace=short > count - 4)
    steps = np.concatenate([steps, np.stack([begin, begin + rng.integers(2, 5, short)], axis=1)])
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


def with_weak_steps(made: Drive, sigma: float, seed: int) -> Drive:
    """The drive in the plane with steps that err by so many radians and metres, and state it."""
    graph, steps = made.graph, np.abs(np.diff(made.graph.edges, axis=1)[:, 0]) == 1
    off = se3.exp(_noise(np.random.default_rng(seed), np.where(steps[:, None], sigma, [[0.0, 0.0]]), 2))
    information = graph.information.copy()
    information[np.ix_(steps, PLANAR_AXES, PLANAR_AXES)] = np.eye(3) / sigma**2
    return replace(made, graph=replace(graph, i_from_j=graph.i_from_j @ off, information=information))


def round_trip(
    seed: int, loops: int, *, dimension: int = 3, wrong: int = 0, group: int = 1, only_wrong: bool = False
) -> Drive:
    """A circle of 500 steps that ends with `loops` of one place, and as many as `wrong` between others in groups."""
    count, rng = 500 + loops, np.random.default_rng(seed)
    turns = np.zeros((count, 6))
    turns[:, 2] = 2 * np.pi * np.arange(count) / 500
    truth = se3.exp(turns)
    truth[:, :2, 3] = 500 / (2 * np.pi) * np.stack([np.sin(turns[:, 2]), -np.cos(turns[:, 2])], axis=1)
    starts = np.repeat(rng.integers(0, count - group, (-(-wrong // group), 2)), group, axis=0)[:wrong]
    mistaken = starts + np.tile(np.arange(group), len(starts))[: len(starts), None]
    closing = np.arange(loops)[:, None] + ([50, 350] if only_wrong else [0, 500])
    steps = np.stack([np.arange(count - 1), np.arange(1, count)], axis=1)
    edges = np.concatenate([steps, closing, mistaken[np.abs(np.diff(mistaken, axis=1)[:, 0]) > 1]])
    exact = se3.inverse(truth[edges[:, 0]]) @ truth[edges[:, 1]]
    exact[count - 1 :] = np.eye(4)
    size = np.repeat(np.where(np.arange(len(edges))[:, None] < count - 1, [[0.003, 0.03]], [[0.01, 0.05]]), 3, axis=1)
    noise = size * rng.standard_normal(size.shape)
    information = np.eye(6) / size[:, None, :] ** 2
    if dimension == 2:
        noise[:, [0, 1, 5]] = information[:, [0, 1, 5]] = 0
    graph = ViewGraph.from_edges(np.arange(count), edges, exact @ se3.exp(noise), information, dimension=dimension)
    return Drive(graph, truth, np.arange(len(edges)) < count - 1 + (0 if only_wrong else loops))


def at_one_place(made: Drive, count: int, *, group: int = 1, spans: int | None = None, seed: int = 0) -> Drive:
    """The graph with as many wrong loops besides that take two of its places for one, as a place recogniser does, in
    groups of this size; `spans`: places up to so many steps apart, else any (the injections of Sünderhauf 2012).
    """
    rng, graph = np.random.default_rng(seed), made.graph
    last = graph.vertex_count - 1 - group
    edges, motion = [], []
    while len(edges) < count:
        first = int(rng.integers(0, last))
        second = int(rng.integers(0, last)) if spans is None else min(last, first + int(rng.integers(0, spans + 1)))
        first, second = min(first, second), max(first, second)
        off = se3.exp(_noise(rng, np.array([[np.radians(10), 0.3]]), graph.dimension))[0]
        if first != second:
            edges += [(first + k, second + (second == first + 1) + k) for k in range(group)]
            motion += [off] * group
    loops = graph.information[np.abs(np.diff(graph.edges, axis=1)[:, 0]) > 1]
    stated = np.median(loops if len(loops) else graph.information, axis=0)
    whole = ViewGraph.from_edges(
        graph.vertex_ids,
        np.concatenate([graph.edges, edges[:count]]),
        np.concatenate([graph.i_from_j, motion[:count]]),
        np.concatenate([graph.information, np.tile(stated, (count, 1, 1))]),
        dimension=graph.dimension,
    )
    return Drive(whole, made.truth, np.concatenate([made.right, np.zeros(count, bool)]))


WORLDS = ("ring", "town", "corridor", "room")


def broken(made: Drive, step: int, *, shift_m: float = 5.0, turn_deg: float = 30.0, seed: int = 0) -> ViewGraph:
    """The graph with the edge between vertices `step` and `step + 1` off by so much in a random direction."""
    rng = np.random.default_rng(seed)
    graph, xi = made.graph, np.zeros(6)
    way, axis = rng.normal(size=(2, 3))
    if graph.dimension == 2:
        way, axis = np.array([way[0], way[1], 0.0]), np.array([0.0, 0.0, axis[2]])
    off = np.eye(4)
    xi[:3] = np.radians(turn_deg) * axis / np.linalg.norm(axis)
    off[:3, :3], off[:3, 3] = se3.exp(xi)[:3, :3], shift_m * way / np.linalg.norm(way)
    row = int(np.flatnonzero((np.sort(graph.edges, axis=1) == [step, step + 1]).all(axis=1))[0])
    motion = graph.i_from_j.copy()
    motion[row] = motion[row] @ off
    return replace(graph, i_from_j=motion)


def spanned(made: Drive) -> Ints:
    """Steps that a right loop spans."""
    loops = made.graph.edges[made.right & (np.abs(np.diff(made.graph.edges, axis=1)[:, 0]) > 1)]
    low, high = np.sort(loops, axis=1).T
    count = made.graph.vertex_count
    change = np.bincount(low, minlength=count + 1) - np.bincount(high, minlength=count + 1)
    return np.flatnonzero(np.cumsum(change)[: count - 1] > 0)


def _world(rng: np.random.Generator, world: str, count: int, dimension: int) -> Floats:
    """Poses (count, 4, 4), a metre apart: a ring, streets of 20 m, a corridor there and back, a room of 12 m."""
    heading, place = np.empty(count), np.empty((count, 2))
    at, yaw, side = np.zeros(2), 0.0, {"town": 60.0, "room": 6.0}.get(world, 0.0)
    for k in range(count):
        if world == "ring":
            yaw = 6 * np.pi * k / count + np.pi / 2
            at = count / (6 * np.pi) * np.array([np.sin(yaw), -np.cos(yaw)])
        elif world == "corridor":
            reach = min(60, count // 4)
            out = k % (2 * reach) < reach
            yaw = 0.0 if out else np.pi
            at = np.array([reach - abs(k % (2 * reach) - reach), 0.3 * np.sin(k / 7)], float)
        else:
            turns = rng.integers(-1, 2) * np.pi / 2 if world == "town" and k % 20 == 0 else 0.0
            yaw += turns if world == "town" else rng.normal(0, 0.2)
            for _ in range(8):
                ahead = at + [np.cos(yaw), np.sin(yaw)]
                if np.abs(ahead).max() <= side + 1e-6:
                    break
                yaw += np.pi / 2 if world == "town" else np.pi / 4
            at = ahead
        heading[k], place[k] = yaw, at
    twist = np.zeros((count, 6))
    twist[:, 2] = heading
    poses = se3.exp(twist)
    poses[:, :2, 3] = place
    if dimension == 3:
        tilt = np.zeros((count, 6))
        tilt[:, 0], tilt[:, 1] = 0.3 * np.sin(np.arange(count) / 31), 0.2 * np.cos(np.arange(count) / 53)
        poses = poses @ se3.exp(tilt)
        poses[:, 2, 3] = 0.5 * np.sin(np.arange(count) / 97)
    return poses


def _noise(rng: np.random.Generator, size: Floats, dimension: int) -> Floats:
    xi = np.zeros((len(size), 6))
    axes = PLANAR_AXES if dimension == 2 else np.arange(6)
    xi[:, axes] = (rng.normal(size=(len(size), 6)) * np.repeat(size, 3, axis=1))[:, axes]
    return xi


def _wrong(rng: np.random.Generator, truth: Floats, count: int, group: int, dimension: int) -> tuple[Ints, Floats]:
    edges: list[tuple[int, int]] = []
    motion: list[Floats] = []
    while len(edges) < count:
        i, j = rng.integers(0, len(truth) - max(group, 12), 2)
        if np.linalg.norm(truth[i, :3, 3] - truth[j, :3, 3]) < 10:
            continue
        shift = se3.exp(_noise(rng, np.array([[0.3, 2.0]]), dimension))[0]
        world_from_world = truth[i] @ shift @ se3.inverse(truth[j])
        for k in range(group):
            edges.append((i + k, j + k))
            motion.append(se3.inverse(truth[i + k]) @ world_from_world @ truth[j + k])
    return np.array(edges[:count], np.int64).reshape(-1, 2), np.array(motion[:count]).reshape(-1, 4, 4)


def two_laps(seed: int, *, wrong: float = 0.2, bias: float = 0.001, lap: int = 300) -> Drive:
    """Two laps of a circle in space by an odometry that turns too far by the same at each step, loops of the second
    lap over the first, some wrong, and the information that hdl_graph_slam states: errors of 5 m and .2 rad.
    """
    rng, count, radius = np.random.default_rng(seed), 2 * lap, 3 * lap / (2 * np.pi)
    angle = 2 * np.pi * np.arange(count) / lap
    truth = se3.exp(np.outer(angle, [0, 0, 1, 0, 0, 0]))
    truth[:, :3, 3] = np.column_stack([radius * np.sin(angle), -radius * np.cos(angle), np.zeros(count)])
    steps = [(k, k + 1) for k in range(count - 1)]
    edges = np.array(steps + [(k, k + lap + int(rng.integers(-2, 3))) for k in range(5, lap - 5, 5)])
    twist = rng.normal(size=(len(edges), 6)) * np.repeat([0.002, 0.05], 3)
    twist[: len(steps), :3] += bias * rng.normal(size=3)
    motions = se3.inverse(truth[edges[:, 0]]) @ truth[edges[:, 1]] @ se3.exp(twist)
    right = np.concatenate([np.ones(len(steps), bool), rng.random(len(edges) - len(steps)) >= wrong])
    for row in np.flatnonzero(~right):
        off = np.concatenate([rng.normal(0, 0.3, 3), rng.normal(0, 20, 3)])
        motions[row] = motions[row] @ se3.exp(off[None])[0]
    information = np.tile(np.diag(np.repeat([25.0, 0.04], 3)), (len(edges), 1, 1))
    return Drive(ViewGraph.from_edges(np.arange(count), edges, motions, information), truth, right)


def field(seed: int) -> Drive:
    """A field that is mown in eight rows, two metres apart, with 70 loops between near rows and 30 that take a row for
    the next one.
    """
    rng, position = np.random.default_rng(seed), np.arange(160)
    row, along = np.divmod(position, 20)
    places = np.stack([np.where(row % 2, 19 - along, along), 2.0 * row, 0.0 * row], axis=1)
    truth = se3.from_parts(se3.so3_exp(np.outer(np.where(row % 2, np.pi, 0.0), [0.0, 0.0, 1.0])), places)
    moved = np.eye(4)
    moved[1, 3] = 2.0

    def ends(shift: Floats, count: int) -> Ints:
        near = cKDTree(places + shift).query_ball_point(places, 2.3)
        pairs = np.array([(i, j) for i, others in enumerate(near) for j in others if abs(i - j) > 8])
        return pairs[rng.choice(len(pairs), count, replace=False)]

    steps = np.stack([position[:-1], position[1:]], axis=1)
    good, bad = ends(np.zeros(3), 70), ends(moved[:3, 3], 30)
    edges, right = np.concatenate([steps, good, bad]), len(steps) + len(good)
    motion = se3.inverse(truth[edges[:, 0]]) @ truth[edges[:, 1]]
    motion[right:] = se3.inverse(truth[bad[:, 0]]) @ moved @ truth[bad[:, 1]]
    sigma = np.where(np.arange(len(edges))[:, None] < len(steps), [[0.01] * 3 + [0.03] * 3], [[0.01] * 3 + [0.05] * 3])
    motion = motion @ se3.exp(rng.normal(size=sigma.shape) * sigma)
    graph = ViewGraph.from_edges(position, edges, motion, np.eye(6) / sigma[:, None, :] ** 2, dimension=3)
    return Drive(graph, np.asarray(truth), np.arange(len(edges)) < right)


def offices(seed: int, right: int, wrong: int) -> Drive:
    """Six corridors of 40 m, 20 m apart, walked from end to end in any order, with loops between places seen again, and
    wrong ones that take a corridor for the next one.
    """
    rng, places, row, is_far = np.random.default_rng(seed), list[tuple[float, float]](), 0, False
    while len(places) < 1600:
        along = np.arange(0, 40, 0.5)
        places += [(40 - x if is_far else x, 20.0 * row) for x in along]
        is_far, other = not is_far, int(np.clip(row + rng.choice([-1, 1]), 0, 5))
        places += [(40.0 * is_far, y) for y in np.linspace(20 * row, 20 * other, 40, endpoint=False)]
        row = other
    xyz = np.column_stack([np.array(places[:1600]) + rng.normal(0, 0.1, (1600, 2)), np.zeros(1600)])
    ahead = np.diff(xyz, axis=0, append=xyz[-1:])
    truth = se3.from_parts(se3.so3_exp(np.outer(np.arctan2(ahead[:, 1], ahead[:, 0]), [0.0, 0.0, 1.0])), xyz)
    moved, tree = np.tile(np.eye(4), (3, 1, 1)), cKDTree(xyz)
    moved[1:, 1, 3] = 20.0, -20.0
    edges, motions = [np.stack([np.arange(1599), np.arange(1, 1600)], axis=1)], [se3.inverse(truth[:-1]) @ truth[1:]]
    for aside, count in zip(moved, (right, wrong // 2, wrong - wrong // 2), strict=True):
        near = tree.query_ball_point(xyz + aside[:3, 3], 1.0)
        pairs = np.array([(i, j) for i, others in enumerate(near) for j in others if abs(i - j) > 60])
        pairs = pairs[rng.choice(len(pairs), count, replace=False)]
        edges.append(pairs)
        motions.append(se3.inverse(aside @ truth[pairs[:, 0]]) @ truth[pairs[:, 1]])
    ends, exact = np.concatenate(edges), np.concatenate(motions)
    size = np.where(np.arange(len(ends))[:, None] < 1599, [[0.003, 0.02]], [[0.01, 0.05]])
    information = np.zeros((len(ends), 6, 6))
    information[:, PLANAR_AXES, PLANAR_AXES] = 1 / np.repeat(size, 3, axis=1)[:, PLANAR_AXES] ** 2
    graph = ViewGraph.from_edges(np.arange(1600), ends, exact @ se3.exp(_noise(rng, size, 2)), information, dimension=2)
    return Drive(graph, truth, np.arange(len(ends)) < 1599 + right)
