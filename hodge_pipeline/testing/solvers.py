"""The contract of solvers, one named property after the other."""

from __future__ import annotations

import pickle
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.errors import GraphError
from hodge_pipeline.stages import ConsistencySolver
from hodge_pipeline.testing.stage import Contract
from hodge_pipeline.types import Floats, Priors, Solution, ViewGraph

SIGMA, START_OFF = 1e-3, 0.02
"""Radians and metres: standard deviations of the edges and of the start."""
EXACT, NO_CHANGE = 1e-3, 1e-5
"""Radians and metres: what a few solver steps may leave of the start's errors where edges are exact; and differences
that second-order terms make, a hundredth of the edges' errors."""


class Ring(NamedTuple):
    """A graph, its true poses (V, 4, 4), and a start (V, 4, 4) that is a little off."""

    graph: ViewGraph
    truth: Floats
    start: Floats


def _ring(noise: float = SIGMA, count: int = 12) -> Ring:
    """Poses on a circle of 2 m, each joined to the next three; the noise is in radians and metres."""
    rng = np.random.default_rng(0)
    angle = 2 * np.pi * np.arange(count) / count
    upright = np.stack([0 * angle, 0 * angle, angle], axis=1)
    truth = se3.from_parts(se3.so3_exp(upright), 2 * np.stack([np.cos(angle), np.sin(angle), 0.1 * angle], axis=1))
    edges = np.array([(i, (i + step) % count) for step in (1, 2, 3) for i in range(count)])
    exact = se3.inverse(truth[edges[:, 0]]) @ truth[edges[:, 1]]
    measured = exact @ se3.exp(noise * rng.normal(size=(len(edges), 6)))
    information = np.tile(np.eye(6) / SIGMA**2, (len(edges), 1, 1))
    start = truth @ se3.exp(START_OFF * rng.normal(size=(count, 6)))
    return Ring(ViewGraph.from_edges(100 + np.arange(count), edges, measured, information), truth, start)


def _without_edges(count: int) -> tuple[ViewGraph, Floats]:
    start = se3.exp(np.random.default_rng(1).normal(size=(count, 6)))
    return ViewGraph.from_edges(np.arange(count), np.zeros((0, 2), np.int64), np.zeros((0, 4, 4))), start


def _solved(solver: ConsistencySolver, graph: ViewGraph, start: Floats) -> Solution:
    """The solution, after asserting that it has the form of one and that nothing given was changed."""
    before = pickle.dumps((graph, start))
    solution = solver.solve(graph, start)
    assert pickle.dumps((graph, start)) == before, "it changes the graph or the start that it is given"
    poses, count = solution.world_from_cam, graph.vertex_count
    assert poses.shape == (count, 4, 4) and poses.dtype == np.float64, f"poses are {poses.dtype} {poses.shape}"
    assert se3.is_motion(poses, 1e-6).all(), "a pose is not a rigid motion"
    assert solution.component.shape == (count,), f"component has the shape {solution.component.shape} for {count}"
    weights = solution.weights
    assert weights.shape == (graph.edge_count,), f"weights have the shape {weights.shape} for {graph.edge_count} edges"
    assert np.isfinite(weights).all() and (weights >= 0).all(), "weights are finite and not negative"
    assert all(isinstance(note, str) for note in solution.notes), "notes are sentences"
    return solution


def _assert_near(poses: Floats, expected: Floats, tolerance: float, what: str) -> None:
    off = np.abs(poses - expected).max()
    assert off <= tolerance, f"{what}: off by {off:.2g}, more than {tolerance:.2g}"


def _relative(poses: Floats) -> Floats:
    """The poses in the first one's axes."""
    return np.asarray(se3.inverse(poses[:1]) @ poses)


def _refuses(solver: ConsistencySolver, graph: ViewGraph, start: Floats, words: Sequence[str]) -> bool:
    """Whether it raises a `GraphError` with all of the words; the solve is checked where it does not raise."""
    try:
        _solved(solver, graph, start)
    except GraphError as error:
        return all(word in str(error) for word in words)
    return False


def _gives_back_exact_poses(solver: ConsistencySolver) -> None:
    graph, truth, start = _ring(0.0)
    poses = _solved(solver, graph, start).world_from_cam
    _assert_near(_relative(poses), _relative(truth), EXACT, "exact edges do not give back the true poses")
    _assert_near(poses[0], start[0], 1e-9, "the first vertex does not keep its start pose")


def _repeats_itself(solver: ConsistencySolver) -> None:
    graph, _, start = _ring()
    one, two = (_solved(solver, graph, start).world_from_cam for _ in range(2))
    assert np.array_equal(one, two), "the same input gives other bits when solved again"


def _refuses_an_empty_graph(solver: ConsistencySolver) -> None:
    assert _refuses(solver, *_without_edges(0), ()), "it must raise GraphError"


def _keeps_poses_without_edges(solver: ConsistencySolver) -> None:
    for count in (1, 3):
        graph, start = _without_edges(count)
        solution = _solved(solver, graph, start)
        _assert_near(solution.world_from_cam, start, 1e-9, f"{count} vertices without an edge do not keep their poses")
        assert solution.notes, f"{count} vertices without an edge: no note says that nothing was solved"


def _ignores_edges_without_information(solver: ConsistencySolver) -> None:
    graph, _, start = _ring()
    solution = _solved(solver, replace(graph, information=np.zeros_like(graph.information)), start)
    _assert_near(solution.world_from_cam, start, 1e-9, "edges without information move poses")
    assert not solution.weights.any(), "an edge without information has a weight"
    assert any("information" in note for note in solution.notes), "no note tells of edges without information"


def _refuses_motions_that_are_not_rigid(solver: ConsistencySolver) -> None:
    graph, _, start = _ring()
    i, j = graph.vertex_ids[graph.edges[7]]
    motion = graph.i_from_j[7]
    faults = {
        "transposed": motion.T,
        "mirrored": motion @ np.diag([-1.0, 1, 1, 1]),
        "scaled": motion @ np.diag([1.1, 1.1, 1.1, 1]),
        "not finite": np.full((4, 4), np.nan),
    }
    for fault, matrix in faults.items():
        motions = graph.i_from_j.copy()
        motions[7] = matrix
        refused = _refuses(solver, replace(graph, i_from_j=motions), start, (str(i), str(j)))
        assert refused, f"an edge that is {fault} must raise a GraphError that names its vertices {i} and {j}"


def _holds_fixed_vertices(solver: ConsistencySolver) -> None:
    graph, truth, start = _ring(0.0)
    start[[3, 8]] = truth[[3, 8]]
    held = replace(graph, fixed=np.array([3, 8]))
    if _refuses(solver, held, start, ("fixed",)):
        return
    poses = _solved(solver, held, start).world_from_cam
    _assert_near(poses, truth, EXACT, "the others do not follow the fixed vertices")
    start[8, 0, 3] += 0.1
    poses = _solved(solver, held, start).world_from_cam
    _assert_near(poses[[3, 8]], start[[3, 8]], 1e-9, "a fixed vertex that the edges contradict moves")


def _heeds_priors(solver: ConsistencySolver) -> None:
    graph, truth, start = _ring(0.0)
    there = se3.exp(np.array([0.1, -0.2, 0.3, 1.0, 2.0, 3.0])) @ truth
    known = replace(graph, priors=Priors(np.array([4]), there[4:5], 1e6 * np.eye(6)[None]))
    if not _refuses(solver, known, start, ("prior",)):
        poses = _solved(solver, known, start).world_from_cam
        _assert_near(poses, there, EXACT, "poses do not lie where the only prior says")


def _does_not_mind_the_directions(solver: ConsistencySolver) -> None:
    graph, _, start = _ring()
    turned = np.arange(graph.edge_count) % 2 == 0
    edges, motions, information = graph.edges.copy(), graph.i_from_j.copy(), graph.information.copy()
    edges[turned], motions[turned] = edges[turned, ::-1], se3.inverse(motions[turned])
    information[turned] = se3.pull_back(motions[turned], information[turned])
    other = replace(graph, edges=edges, i_from_j=motions, information=information)
    one, two = (_solved(solver, given, start).world_from_cam for given in (graph, other))
    _assert_near(one, two, NO_CHANGE, "half of the edges measured the other way give other poses")


def _does_not_mind_the_unit(solver: ConsistencySolver) -> None:
    graph, _, start = _ring()
    unit = np.repeat([1.0, 1e-3], 3)
    large, far = graph.i_from_j.copy(), start.copy()
    large[:, :3, 3] *= 1e3
    far[:, :3, 3] *= 1e3
    scaled = replace(graph, i_from_j=large, information=graph.information * np.outer(unit, unit))
    poses = _solved(solver, scaled, far).world_from_cam.copy()
    poses[:, :3, 3] /= 1e3
    _assert_near(poses, _solved(solver, graph, start).world_from_cam, NO_CHANGE, "millimetres give other poses")


def _with_copies(wrong_at: int) -> Ring:
    """The ring with three edges between the two vertices of its sixth, one of them wrong."""
    graph, truth, start = _ring()
    tripled = graph.select(np.insert(np.arange(graph.edge_count), 5, [5, 5]))
    motions = tripled.i_from_j.copy()
    motions[5 + wrong_at] = motions[5 + wrong_at] @ se3.exp(np.array([0.5, 0.3, 0, 1.0, 0, -0.5]))
    return Ring(replace(tripled, i_from_j=motions), truth, start)


def _does_not_mind_the_order_of_copies(solver: ConsistencySolver) -> None:
    first, last = _with_copies(0), _with_copies(2)
    one, two = (_solved(solver, given.graph, first.start).world_from_cam for given in (first, last))
    _assert_near(one, two, NO_CHANGE, "a wrong copy of an edge counts otherwise before the right ones than after")


def _leaves_out_a_wrong_copy(solver: ConsistencySolver) -> None:
    graph, truth, start = _with_copies(0)
    solution = _solved(solver, graph, start)
    _assert_near(
        _relative(solution.world_from_cam), _relative(truth), 10 * SIGMA, "a wrong copy of an edge is believed"
    )
    assert solution.weights[5] < 0.1 * solution.weights[6:8].min(), "a wrong copy weighs as much as the right ones"


def _solves_components_apart(solver: ConsistencySolver) -> None:
    small, large = _ring(0.0, 5), _ring(0.0, 12)
    count = small.graph.vertex_count
    graph = ViewGraph.from_edges(
        np.arange(count + 12 + 1),
        np.concatenate([small.graph.edges, large.graph.edges + count]),
        np.concatenate([small.graph.i_from_j, large.graph.i_from_j]),
        np.concatenate([small.graph.information, large.graph.information]),
    )
    start = np.concatenate([small.start, large.start, np.eye(4)[None]])
    solution = _solved(solver, graph, start)
    parts, poses = (slice(0, count), slice(count, count + 12)), solution.world_from_cam
    assert solution.component.tolist() == [1] * count + [0] * 12 + [2], "components are numbered by their size"
    for part, truth in zip(parts, (small.truth, large.truth), strict=True):
        _assert_near(_relative(poses[part]), _relative(truth), EXACT, "a component is not solved as it is alone")
        _assert_near(poses[part][0], start[part][0], 1e-9, "the first vertex of a component does not keep its pose")
    _assert_near(poses[-1], start[-1], 1e-9, "a vertex without edges does not keep its pose")
    assert any("pieces" in note for note in solution.notes), "no note tells of the pieces"


check_solver = Contract(
    ConsistencySolver,
    {
        "exact edges": _gives_back_exact_poses,
        "the same bits again": _repeats_itself,
        "empty graph": _refuses_an_empty_graph,
        "no edges": _keeps_poses_without_edges,
        "zero information": _ignores_edges_without_information,
        "motions not rigid": _refuses_motions_that_are_not_rigid,
        "fixed vertices": _holds_fixed_vertices,
        "priors": _heeds_priors,
        "reversed edges": _does_not_mind_the_directions,
        "units x 1000": _does_not_mind_the_unit,
        "order of parallel edges": _does_not_mind_the_order_of_copies,
        "wrong copy of an edge": _leaves_out_a_wrong_copy,
        "disconnected graph": _solves_components_apart,
    },
)
"""Checks a solver on a small ring of poses. It may refuse fixed vertices and priors by a `GraphError` that names them,
but not ignore them."""
