"""Graphs whose right answer is known, spoilt in known ways: what `wrong_loops.py` measures on.

Walks that are simulated, graphs of the literature and those of SLAM, with wrong loops, steps or both put in.
"""

from __future__ import annotations

import itertools
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))

from edges_peers import consecutive as steps
from simulated_edges import between
from slam_loops import BICOCCA_M, ROBOTCAR_M, SHARED, bicocca, robotcar

from hodge_pipeline import se3
from hodge_pipeline.refine.pose_graph import read_graph
from hodge_pipeline.solvers.maximum_likelihood import solve
from hodge_pipeline.types import Bools, Floats, Ints, ViewGraph

GRAPHS = SHARED.parent
BROKEN = ("B25b 0.500", "robotcar short", "INTEL", "kitti_00", "MIT")
BREAK_M, BREAK_RAD, PLACES = 5.0, np.radians(30.0), 20
CLEAN = (
    "sphere2500",
    "parking-garage",
    "torus3D",
    "manhattan",
    "intel",
    "kitti_00",
    "cubicle",
    "CSAIL",
    "smallGrid3D",
    "MIT",
    "kitti_05",
)
INJECTED = (
    ("sphere2500", 500),
    ("torus3D", 100),
    ("torus3D", 500),
    ("smallGrid3D", 30),
    ("manhattan", 500),
    ("intel", 500),
    ("CSAIL", 200),
    ("kitti_00", 100),
    ("parking-garage", 500),
)
REPLACED = ("intel", "CSAIL", "kitti_00", "kitti_05", "manhattan", "MIT")
GROUPS = (1, 10)
MISTAKES = ("displaced", "turned round", "shortened", "inverted")
NOISE = np.repeat([0.005, 0.02], 3)


@dataclass(frozen=True)
class Case:
    """A graph with its true positions (V, 2 or 3) and where (E,) its edges are right."""

    name: str
    graph: ViewGraph
    places: Floats
    right: Bools


def load(path: Path) -> ViewGraph:
    graph = read_graph(path).graph
    assert graph is not None
    return graph


def with_edges(graph: ViewGraph, edges: Ints, motions: Floats) -> ViewGraph:
    """The graph with these edges (N, 2), motions (N, 4, 4), put behind its own, of their usual information."""
    both = np.concatenate([graph.edges, edges]), np.concatenate([graph.i_from_j, motions])
    information = np.broadcast_to(np.median(graph.information, axis=0), (len(edges), 6, 6))
    return ViewGraph.from_edges(graph.vertex_ids, *both, information=np.concatenate([graph.information, information]))


def wrong_loops(
    poses: Floats, count: int, group: int, rng: np.random.Generator, flat: bool = False
) -> tuple[Ints, Floats]:
    """`count` loops (N, 2), (N, 4, 4), in groups of `group` that agree: two places taken for the same."""
    pairs, motions = [], []
    for _ in range(-(-count // group)):
        first, second = rng.choice(len(poses), 2, replace=False)
        turn = [0.0, 0.0, rng.normal(0, 0.4)] if flat else rng.normal(0, 0.3, 3)
        off = np.concatenate([turn, rng.normal(0, 0.7, 3) * ([1, 1, 0] if flat else 1)])
        mistaken = poses[first] @ se3.exp(off[None])[0] @ se3.inverse(poses[second])
        reach = 0 if group == 1 else group // 2
        pair = np.clip(np.array([first, second]) + rng.integers(-reach, reach + 1, (group, 2)), 0, len(poses) - 1)
        pair = pair[np.abs(pair[:, 0] - pair[:, 1]) > 1]
        noise = rng.normal(size=(len(pair), 6)) * NOISE * ([0, 0, 1, 1, 1, 0] if flat else 1)
        pairs.append(pair)
        motions.append(se3.inverse(poses[pair[:, 0]]) @ mistaken @ poses[pair[:, 1]] @ se3.exp(noise))
    return np.concatenate(pairs)[:count], np.concatenate(motions)[:count]


def slam_graphs() -> Iterator[tuple[str, ViewGraph, Floats, Bools]]:
    """Name, graph, true places and right edges; a loop whose truth is unknown counts as right."""
    for path in sorted((SHARED / "bicocca").glob("*.g2o")):
        graph = load(path)
        places, off = bicocca(path.parent, graph)
        yield path.stem.replace("_", " "), graph, places, ~(off > BICOCCA_M)
    for path in sorted((SHARED / "robotcar").glob("*/graph.g2o")):
        graph = load(path)
        places, off = robotcar(path.parent, graph)
        yield f"robotcar {path.parent.name}", graph, places, ~(off > ROBOTCAR_M)


def random_cases(seed: int) -> Iterator[Case]:
    """Every loop joins two vertices drawn anew."""
    for name, graph, places, _ in slam_graphs():
        rng, edges = np.random.default_rng(seed), graph.edges.copy()
        loop = np.flatnonzero(~steps(graph))
        drawn = np.sort(np.array([rng.choice(graph.vertex_count, 2, replace=False) for _ in loop]), axis=1)
        edges[loop] = drawn
        right = np.ones(len(edges), bool)
        right[loop] = False
        spoilt = ViewGraph.from_edges(graph.vertex_ids, edges, graph.i_from_j, information=graph.information)
        yield Case(name, spoilt, places, right)


def own_optimum(graph: ViewGraph) -> Floats:
    return np.asarray(solve(graph).world_from_cam)


def classical_cases(seed: int) -> Iterator[Case]:
    for name, count in INJECTED:
        graph = load(GRAPHS / "sesync" / f"{name}.g2o")
        poses = own_optimum(graph)
        flat = bool(np.ptp(poses[:, 2, 3]) < 1e-6)
        for group in GROUPS:
            rng = np.random.default_rng(seed)
            more, motions = wrong_loops(poses, count, group, rng, flat=flat)
            right = np.arange(len(graph.edges) + len(more)) < len(graph.edges)
            yield Case(f"{name} +{count} by {group}", with_edges(graph, more, motions), poses[:, :3, 3], right)


def replaced_cases(seed: int) -> Iterator[Case]:
    """Every loop replaced by a wrong one, alone or in groups that agree: two places taken for the same."""
    for name in REPLACED:
        whole = load(GRAPHS / "sesync" / f"{name}.g2o")
        poses, odometry = own_optimum(whole), whole.select(np.flatnonzero(steps(whole)))
        count, flat = whole.edge_count - odometry.edge_count, bool(np.ptp(poses[:, 2, 3]) < 1e-6)
        for group in GROUPS:
            rng = np.random.default_rng([seed, group])
            graph = with_edges(odometry, *wrong_loops(poses, count, group, rng, flat=flat))
            right = np.arange(graph.edge_count) < odometry.edge_count
            yield Case(f"{name}, {count} wrong by {group}", graph, poses[:, :3, 3], right)


def clean_cases(seed: int) -> Iterator[Case]:
    for name in CLEAN:
        graph = load(GRAPHS / "sesync" / f"{name}.g2o")
        yield Case(name, graph, own_optimum(graph)[:, :3, 3], np.ones(len(graph.edges), bool))


def broken_cases(seed: int) -> Iterator[Case]:
    """One step that a right loop spans displaced by 5 m and 30° (about the vertical where the graph is flat)."""
    graphs = {name: (graph, places, right) for name, graph, places, right in slam_graphs()}
    for name in ("INTEL", "kitti_00", "MIT"):
        found = [path for path in GRAPHS.glob(f"*/{name}.g2o")]
        graph = load(found[0])
        graphs[name] = graph, own_optimum(graph)[:, :3, 3], np.ones(len(graph.edges), bool)
    for name, (graph, places, right) in graphs.items():
        if name not in BROKEN:
            continue
        i, j = np.sort(graph.edges, axis=1).T
        loop = ~steps(graph) & right
        spanned = np.zeros(graph.vertex_count + 1, int)
        np.add.at(spanned, i[loop], 1)
        np.add.at(spanned, j[loop], -1)
        rng = np.random.default_rng(seed)
        able = np.flatnonzero(steps(graph) & (np.cumsum(spanned)[i] > 0))
        flat = bool(np.ptp(graph.i_from_j[:, 2, 3]) < 1e-9)
        for row in rng.choice(able, min(PLACES, len(able)), replace=False):
            way = rng.normal(size=3) * ([1, 1, 0] if flat else 1)
            axis = np.array([0.0, 0, 1]) if flat else rng.normal(size=3)
            off = np.concatenate([axis / np.linalg.norm(axis) * BREAK_RAD, way / np.linalg.norm(way) * BREAK_M])
            motions = graph.i_from_j.copy()
            motions[row] = motions[row] @ se3.exp(off[None])[0]
            still = right.copy()
            still[row] = False
            yield Case(
                f"{name} step {row}",
                ViewGraph.from_edges(graph.vertex_ids, graph.edges, motions, information=graph.information),
                places,
                still,
            )


def simulated_cases(seed: int) -> Iterator[Case]:
    """Walks that come back to where they were, with a drifting odometry, right loops and wrong ones."""
    number = 0
    for kind in ("ring", "corridor", "streets"):
        for wrong in (0, 10, 50, 200):
            for group in (1, 5, 10) if wrong else (1,):
                for stated in (True, False):
                    for loops in (5, 40, 200):
                        rng = np.random.default_rng([seed, number])
                        number += 1
                        poses = walk(kind, int(rng.integers(150, 500)), rng)
                        known = "stated" if stated else "unknown"
                        name = f"{kind}, {loops} right, {wrong} wrong by {group}, information {known}"
                        yield walked(name, poses, loops, wrong, group, stated, rng)


def short_cases(seed: int) -> Iterator[Case]:
    """Walks of few steps and few loops, of which none to .6 are wrong, with none to three steps wrong."""
    kinds = itertools.product(
        ("ring", "corridor"),
        (15, 30, 60, 95),
        (0.15, 0.3, 0.5),
        ((0.0, 1), (0.3, 1), (0.3, 4), (0.6, 1), (0.6, 4)),
        (0, 1, 3),
    )
    for number, (kind, count, share, (wrong, group), broken) in enumerate(kinds):
        rng = np.random.default_rng([seed, number])
        bad = round(wrong * share * count)
        name = f"{kind} of {count}, {share:.0%} loops, {wrong:.0%} of them wrong by {group}, {broken} steps"
        case = walked(name, walk(kind, count, rng), round(share * count) - bad, bad, group, True, rng)
        rows = rng.choice(np.flatnonzero(steps(case.graph)), broken, replace=False)
        off = np.zeros((broken, 6))
        off[:, 2:5] = rng.normal(size=(broken, 3)) * [0.5, 1.5, 1.5]
        motions, right = case.graph.i_from_j.copy(), case.right.copy()
        motions[rows], right[rows] = motions[rows] @ se3.exp(off), False
        yield replace(case, graph=replace(case.graph, i_from_j=motions), right=right)


def mistaken_cases(seed: int) -> Iterator[Case]:
    """Walks with as many loops as steps, a third to two thirds of which are mistaken in one way."""
    kinds = itertools.product(("ring", "corridor", "streets"), MISTAKES, (1 / 3, 1 / 2, 2 / 3), (1.0, 10.0))
    for number, (kind, mistake, share, wide) in enumerate(kinds):
        rng = np.random.default_rng([seed, number])
        poses = walk(kind, int(rng.integers(150, 400)), rng)
        case = walked(f"{kind}, {share:.0%} {mistake}, sigmas × {wide:.0f}", poses, len(poses), 0, 1, True, rng)
        loops = np.flatnonzero(~steps(case.graph))
        rows = rng.choice(loops, round(share * len(loops)), replace=False)
        motions, right, pairs = case.graph.i_from_j.copy(), case.right.copy(), case.graph.edges[rows]
        motions[rows] = mistaken(mistake, motions[rows], poses[pairs[:, 0]], rng)
        off = np.abs(se3.log(se3.inverse(motions[rows]) @ between(poses, pairs)))
        right[rows] = (off < 16 * NOISE).all(axis=1)
        graph = replace(case.graph, i_from_j=motions, information=case.graph.information / wide**2)
        yield replace(case, graph=graph, right=right)


def mistaken(mistake: str, motions: Floats, here: Floats, rng: np.random.Generator) -> Floats:
    """Right motions (N, 4, 4) between poses, the first of them `here (N, 4, 4)`, mistaken in one of `MISTAKES`."""
    if mistake == "displaced":
        way = rng.normal(size=2)
        shift = se3.from_parts(np.eye(3), np.append(4 * way / np.linalg.norm(way), 0.0))
        return np.asarray(se3.inverse(here) @ shift @ here @ motions)
    if mistake == "turned round":
        return np.asarray(motions @ np.diag([-1.0, -1.0, 1.0, 1.0]))
    if mistake == "inverted":
        return np.asarray(se3.inverse(motions))
    shorter = motions.copy()
    shorter[:, :3, 3] *= 0.4
    return shorter


def walk(kind: str, count: int, rng: np.random.Generator) -> Floats:
    k = np.arange(count)
    if kind == "ring":
        yaw = 6 * np.pi * k / count
        place = 8 * np.stack([np.cos(yaw), np.sin(yaw)], axis=1)
        yaw = yaw + np.pi / 2
    elif kind == "corridor":
        there = k < count // 2
        yaw = np.where(there, 0.0, np.pi)
        place = np.stack([0.5 * np.where(there, k, count - k), 0.3 * rng.normal(size=count)], axis=1)
    else:
        turns = np.where(k % 15 == 0, rng.integers(-1, 2, count), 0)
        yaw = np.pi / 2 * np.cumsum(turns)
        place = np.cumsum(np.stack([np.cos(yaw), np.sin(yaw)], axis=1), axis=0)
    turned = se3.so3_exp(np.outer(yaw, [0.0, 0, 1]))
    return np.asarray(se3.from_parts(turned, np.column_stack([place, np.zeros(count)])))


def walked(
    name: str, poses: Floats, loops: int, wrong: int, group: int, stated: bool, rng: np.random.Generator
) -> Case:
    count = len(poses)
    path = np.stack([np.arange(count - 1), np.arange(1, count)], axis=1)
    i, j = np.triu_indices(count, min(20, count // 5))
    near = np.flatnonzero(np.linalg.norm(poses[i, :3, 3] - poses[j, :3, 3], axis=1) < 2.0)
    chosen = rng.choice(near, min(loops, len(near)), replace=False)
    pairs = np.concatenate([path, np.stack([i, j], axis=1)[chosen]])
    spread = np.where(np.arange(len(pairs))[:, None] < count - 1, NOISE, 2 * NOISE)
    motions = between(poses, pairs) @ se3.exp(rng.normal(size=(len(pairs), 6)) * spread)
    more, bad = wrong_loops(poses, wrong, group, rng) if wrong else (pairs[:0], motions[:0])
    edges, motion = np.concatenate([pairs, more]), np.concatenate([motions, bad])
    spread = np.concatenate([spread, np.broadcast_to(2 * NOISE, (len(more), 6))])
    information = np.eye(6) / spread[:, None, :] ** 2 if stated else None
    off = np.abs(se3.log(se3.inverse(motion) @ between(poses, edges)))
    right = (off < 8 * spread).all(axis=1)
    order = rng.permutation(len(edges)) if rng.integers(2) else np.arange(len(edges))
    information = None if information is None else information[order]
    graph = ViewGraph.from_edges(np.arange(count), edges[order], motion[order], information=information)
    return Case(name, graph, poses[:, :3, 3], np.asarray(right)[order])


def lattice_cases(seed: int) -> Iterator[Case]:
    """Cylinders with and without diagonals and rows walked to and fro, any edge of which may be wrong."""
    for kind in ("cylinder", "triangles", "rows"):
        for count in (200, 500, 1000):
            for share in (0.01, 0.05, 0.1, 0.2):
                rng = np.random.default_rng([seed, count, int(100 * share)])
                round_, k = 20, np.arange(count)
                if kind == "rows":
                    row, along = k // round_, k % round_
                    place = np.stack([np.where(row % 2, round_ - 1 - along, along), row, 0 * k], axis=1).astype(float)
                    yaw = np.where(row % 2, np.pi, 0.0)
                else:
                    yaw = 2 * np.pi * k / round_
                    place = np.stack([3 * np.cos(yaw), 3 * np.sin(yaw), k / round_], axis=1)
                poses = np.asarray(se3.from_parts(se3.so3_exp(np.outer(yaw, [0.0, 0, 1])), place))
                i, j = np.triu_indices(count, 1)
                reach = 1.5 if kind == "triangles" else 1.05
                close = np.linalg.norm(place[i] - place[j], axis=1) < reach
                pairs = np.stack([i, j], axis=1)[close | (j - i == 1)]
                motions = between(poses, pairs) @ se3.exp(rng.normal(size=(len(pairs), 6)) * 2 * NOISE)
                bad = rng.random(len(pairs)) < share
                motions[bad] = motions[bad] @ se3.exp(rng.normal(0, 1, (int(bad.sum()), 6)))
                graph = ViewGraph.from_edges(k, pairs, motions)
                yield Case(f"{kind} of {count}, {share:.0%} wrong", graph, place, ~bad)


def window_cases(seed: int) -> Iterator[Case]:
    """Walks of 600 steps each of whose frames is registered to several before it, with wrong loops, steps and edges."""
    kinds = itertools.product(("ring", "corridor", "streets"), (2, 3, 10), (0.0, 0.5, 0.9, 1.0), (1, 5), (0.0, 0.03))
    for number, (kind, reach, wrong, group, spoilt) in enumerate(kinds):
        rng = np.random.default_rng([seed, number])
        poses, bad, stated = walk(kind, 600, rng), round(100 * wrong), number % 4 < 3
        name = f"{kind}, {reach} steps, {wrong:.0%} of loops wrong by {group}, {spoilt:.0%} of steps and edges, "
        name += "stated" if stated else "unknown"
        case = walked(name, poses, 100 - bad, bad, group, stated, rng)
        graph, apart = case.graph, range(2, reach + 1)
        pairs = np.concatenate([np.stack([np.arange(len(poses) - g), np.arange(g, len(poses))], axis=1) for g in apart])
        spread = np.sqrt(np.diff(pairs, axis=1)) * NOISE
        more = between(poses, pairs) @ se3.exp(rng.normal(size=spread.shape) * spread)
        own = np.eye(6) / spread[:, None, :] ** 2 if stated else np.tile(np.eye(6), (len(pairs), 1, 1))
        window = ViewGraph.from_edges(graph.vertex_ids, pairs, more, own)
        graph = ViewGraph.joined([graph, window])
        rows = np.flatnonzero(steps(graph) | (np.arange(graph.edge_count) >= case.graph.edge_count))
        rows = rows[rng.random(len(rows)) < spoilt]
        off, motions = rng.normal(size=(len(rows), 6)) * np.repeat([0.3, 1.5], 3), graph.i_from_j.copy()
        motions[rows] = motions[rows] @ se3.exp(off)
        right = np.concatenate([case.right, np.ones(len(pairs), bool)])
        right[rows] = False
        yield replace(case, graph=replace(graph, i_from_j=motions), right=right)


def session_cases(seed: int) -> Iterator[Case]:
    """Walks without the steps at one to four places: sessions that only loops join, of which none to .8 are wrong."""
    kinds = itertools.product(("ring", "corridor", "streets"), (2, 3, 5), (0.0, 0.3, 0.6, 0.8), (1, 5))
    for number, (kind, sessions, wrong, group) in enumerate(kinds):
        rng = np.random.default_rng([seed, number])
        poses, bad, stated = walk(kind, 600, rng), round(150 * wrong), number % 3 < 2
        name = f"{kind}, {sessions} sessions, {wrong:.0%} of loops wrong by {group}, "
        case = walked(name + ("stated" if stated else "unknown"), poses, 150 - bad, bad, group, stated, rng)
        begins = np.linspace(0, len(poses), sessions + 1).astype(int)[1:-1]
        left = ~(steps(case.graph) & np.isin(case.graph.edges.max(axis=1), begins))
        yield replace(case, graph=case.graph.select(left), right=case.right[left])


KINDS = {
    "random": random_cases,
    "breaks": broken_cases,
    "replaced": replaced_cases,
    "classical": classical_cases,
    "clean": clean_cases,
    "simulated": simulated_cases,
    "short": short_cases,
    "mistaken": mistaken_cases,
    "lattices": lattice_cases,
    "windows": window_cases,
    "sessions": session_cases,
}
