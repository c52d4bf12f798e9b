"""Given poses and edges that both err: the shape of the path is the given one's, unless edges tell it better."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from hodge_pipeline import se3
from hodge_pipeline.evaluation.trajectory import absolute_error
from hodge_pipeline.refine import given_poses
from hodge_pipeline.refine.given_noise import far_steps, without_noise
from hodge_pipeline.refine.guard import Measure
from hodge_pipeline.refine.uncertainty import reduced_chi2
from hodge_pipeline.solvers.maximum_likelihood import solve
from hodge_pipeline.types import Floats, Solution, ViewGraph

COUNT, SHARED = 50, 100.0
SHARED_SIGMA, OWN_SIGMA = 1e-3, 1e-4
"""Radians and metres: of errors that all edges of a step share, and of an edge's own."""
STATED = np.eye(6) * 0.2 / 14 / SHARED_SIGMA**2
"""Information of an edge: a step of the path is measured by edges over one to three, 1 + 4 + 9 times as well, and its
true variance is `STATED_SHARE` of what these say.
"""
FIRSTS = np.arange(COUNT - 1)


def along(twists: Floats) -> Floats:
    """The poses (N + 1, 4, 4) of steps (N, 6)."""
    poses = [np.eye(4)]
    for step in se3.exp(twists):
        poses.append(poses[-1] @ step)
    return np.array(poses)


STEPS = np.tile([0.0, 0.03, 0.0, 0.1, 0.0, 0.0], (COUNT - 1, 1))
TRUE = along(STEPS)


def rough(sigma: float) -> Floats:
    return np.asarray(TRUE @ se3.exp(sigma * np.random.default_rng(1).normal(size=(COUNT, 6))))


def error_m(poses: Floats) -> float:
    return absolute_error(poses, TRUE).rmse_m


@pytest.fixture(scope="module")
def measured() -> tuple[ViewGraph, Solution]:
    """Edges over one to three steps of a path that never returns, and their poses, which bend."""
    rng = np.random.default_rng(0)
    bent = along(STEPS + SHARED_SIGMA * rng.normal(size=STEPS.shape))
    edges = np.concatenate([np.stack([np.arange(COUNT - k), np.arange(k, COUNT)], axis=1) for k in (1, 2, 3)])
    motions = se3.between(bent, edges) @ se3.exp(OWN_SIGMA * rng.normal(size=(len(edges), 6)))
    graph = ViewGraph.from_edges(np.arange(COUNT), edges, motions, np.tile(STATED, (len(edges), 1, 1)))
    return graph, solve(graph, start=TRUE)


def test_rough_poses_lose_their_noise_and_take_over_no_bend_and_a_second_time_stay(
    measured: tuple[ViewGraph, Solution],
) -> None:
    given = rough(5e-3)
    found = without_noise(*measured, given, FIRSTS, SHARED)
    assert found is not None and error_m(found) < 0.7 * error_m(given)
    assert error_m(found) < error_m(measured[1].world_from_cam)
    assert without_noise(*measured, found, FIRSTS, SHARED) is found


@pytest.mark.parametrize("sigma", [0.0, 3e-4])
def test_poses_as_exact_as_edges_stay_as_they_are(measured: tuple[ViewGraph, Solution], sigma: float) -> None:
    given = rough(sigma)
    assert without_noise(*measured, given, FIRSTS, SHARED) is given


@pytest.mark.parametrize("firsts", [FIRSTS, FIRSTS[:0]])
@pytest.mark.parametrize("jumps_m", [0.06 * (np.arange(COUNT - 1) == 20), np.full(COUNT - 1, 5e-3)])
def test_edges_decide_where_poses_jump_or_bend_by_more_than_both_err(
    measured: tuple[ViewGraph, Solution], jumps_m: Floats, firsts: Floats
) -> None:
    off = STEPS.copy()
    off[:, 4] += jumps_m
    assert without_noise(*measured, along(off), firsts, SHARED) is None


@pytest.mark.parametrize(("sigma", "kept"), [(2e-3, True), (6e-3, False)])
def test_a_drift_no_larger_than_the_bend_of_edges_is_kept(
    measured: tuple[ViewGraph, Solution], sigma: float, kept: bool
) -> None:
    """Judged by the farthest pair alone the edges, 7.6 mm off, took the place of poses that are 6.2 mm off."""
    for seed in range(1, 9):
        given = along(STEPS + sigma * np.random.default_rng(seed).normal(size=STEPS.shape))
        found = without_noise(*measured, given, FIRSTS, SHARED)
        assert found is given if kept else found is None


@pytest.mark.parametrize("twist", [[0, 0.06, 0, 0, 0, 0], [0, 0, 0, 0, 0.06, 0]])
def test_a_step_that_edges_put_far_off_is_a_jump_also_among_several_and_of_rough_poses(
    measured: tuple[ViewGraph, Solution], twist: list[float]
) -> None:
    """Poses 10, 20, 30 and 40 are 60 mm or mrad off, there and back; the mean of squares takes these for roughness."""
    jump = se3.exp(np.array(twist, float))
    for sigma in (0.0, 2e-3):
        given = rough(sigma)
        assert not len(far_steps(*measured, given, FIRSTS, SHARED))
        given[10::10] = given[10::10] @ jump
        assert sorted(far_steps(*measured, given, FIRSTS, SHARED).tolist()) == [9, 10, 19, 20, 29, 30, 39, 40]
    some = far_steps(*measured, given, FIRSTS[15:], SHARED)
    assert sorted(some.tolist()) == [19, 20, 29, 30, 39, 40], "steps within a sequence alone"


def test_edges_that_no_cycle_tests_count_as_stated(measured: tuple[ViewGraph, Solution]) -> None:
    graph, solution = measured
    tree = graph.select(np.arange(COUNT - 1))
    solution = replace(solution, weights=np.ones(COUNT - 1))
    fine, given = rough(4e-3), rough(1e-2)
    assert without_noise(tree, solution, fine, FIRSTS, SHARED) is fine
    found = without_noise(tree, solution, given, FIRSTS, SHARED)
    assert found is not None and error_m(found) < 0.9 * error_m(given)
    given[20:] = se3.exp(np.array([0, 0, 0, 0, 0.5, 0])) @ given[20:]
    assert without_noise(tree, solution, given, FIRSTS, SHARED) is None


def test_pieces_keep_their_places_and_edges_without_a_covariance_decide(measured: tuple[ViewGraph, Solution]) -> None:
    """Two pieces that no edge joins, one of them turned by the solver's own choice of its world."""
    graph, solution = measured
    inside = (graph.edges < 20).all(axis=1) | (graph.edges >= 20).all(axis=1)
    poses = solution.world_from_cam.copy()
    poses[20:] = se3.exp(np.array([0, 0, 1.0, 5, 0, 0])) @ poses[20:]
    component = (np.arange(COUNT) < 20).astype(np.int64)
    pieces = Solution(poses, component, solution.weights[inside])
    given = rough(5e-3)
    found = without_noise(graph.select(inside), pieces, given, FIRSTS, SHARED)
    assert found is not None and error_m(found) < 0.7 * error_m(given)
    indefinite = replace(graph, information=graph.information * np.diag([1.0, 1, 1, 1, 1, -1]))
    assert without_noise(indefinite, solution, given, FIRSTS, SHARED) is None


def test_edges_that_a_robust_solve_left_out_count_for_nothing(measured: tuple[ViewGraph, Solution]) -> None:
    """It leaves them a small rest of weight: one 50 m off made the others look 300 times as bad."""
    graph, solution = measured
    motions, weights = graph.i_from_j.copy(), np.ones(len(graph.edges))
    motions[-1, 0, 3] += 50.0
    weights[-1] = 5e-4
    told = reduced_chi2(replace(graph, i_from_j=motions), replace(solution, weights=weights))
    rest = graph.select(np.arange(len(graph.edges) - 1))
    assert told == pytest.approx(reduced_chi2(rest, replace(solution, weights=weights[:-1])))


def decided(measured: tuple[ViewGraph, Solution], given: Floats, monkeypatch: pytest.MonkeyPatch) -> tuple[Any, Floats]:
    """The decision, and its poses, where pairs held out fit the edges better: they share the errors of these."""
    graph, solution = measured
    better = Measure("score of held-out edges", 0.7, 0.8, "higher", 0.01, is_held_out=True)
    monkeypatch.setattr(given_poses, "spread_corrections", lambda key_frames, after, jumps: after)
    monkeypatch.setattr(given_poses, "_held_out", lambda work, pairs, key_frames, found: (found, [better], None))
    monkeypatch.setattr(
        given_poses, "sure_jumps", lambda work, keys, *_: (np.zeros(0, np.int64), keys.world_from_key, [])
    )
    monkeypatch.setattr(given_poses, "held_out_pairs", lambda rounds: [])
    for name in ("against_images", "path_size", "_settled"):
        monkeypatch.setattr(given_poses, name, lambda *arguments: [])
    guard = SimpleNamespace(force=False, shared_errors=SHARED)
    steps = SimpleNamespace(note=lambda *notes: None)
    work = SimpleNamespace(recipe=SimpleNamespace(scale=1.0, guard=guard), steps=steps)
    key_frames = SimpleNamespace(world_from_key=given, sequence=np.zeros(COUNT), rows=np.arange(COUNT))
    last = SimpleNamespace(graph=graph, solution=solution, world_from_cam=solution.world_from_cam)
    return given_poses._decision(cast("Any", work), cast("Any", [last]), cast("Any", key_frames))


def test_the_guard_keeps_exact_poses_smooths_rough_ones_and_takes_the_edges_where_poses_bend(
    measured: tuple[ViewGraph, Solution], monkeypatch: pytest.MonkeyPatch
) -> None:
    decision, _ = decided(measured, rough(3e-4), monkeypatch)
    assert decision.outcome == "optimal" and decision.reason == given_poses.KEPT
    decision, found = decided(measured, rough(5e-3), monkeypatch)
    assert decision.outcome == "refined" and error_m(found) < error_m(measured[1].world_from_cam)
    decision, found = decided(measured, along(STEPS + np.array([0, 0, 0, 0, 5e-3, 0])), monkeypatch)
    assert decision.outcome == "refined" and found is measured[1].world_from_cam
