from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from backbone_graphs import Drive
from diagnosis_graphs import SIGMA, measured, near_pairs, poses_on_a_ring, spoiled
from hodge_pipeline import se3
from hodge_pipeline.diagnosis.diagnosis import diagnose
from hodge_pipeline.diagnosis.growth import Alignment
from hodge_pipeline.diagnosis.options import DiagnosisOptions
from hodge_pipeline.diagnosis.result import UNTESTABLE, WRONG
from hodge_pipeline.diagnosis.robust import RobustSolver
from hodge_pipeline.rounds.one_round import Registered, judge_edges, solve_edges
from hodge_pipeline.rounds.suggestions import NEIGHBOURS_APART, _missing_sides, suggest_pairs
from hodge_pipeline.solvers.maximum_likelihood import solve
from hodge_pipeline.solvers.poisson import PoissonSolver
from hodge_pipeline.stages import ConsistencySolver, Step, no_progress
from hodge_pipeline.types import Edges, ViewGraph
from hodge_pipeline.types.edges import IGNORED, MEASURED, USED

QUICK = DiagnosisOptions()


def test_the_solver_leaves_wrong_edges_out_and_keeps_the_gauge() -> None:
    poses = poses_on_a_ring(20)
    clean = measured(poses, near_pairs(20, 4))
    graph, right = spoiled(clean, np.random.default_rng(0).choice(80, 20, replace=False))
    solver = RobustSolver(diagnosis=QUICK)
    assert isinstance(solver, ConsistencySolver)
    solution = solver.solve(graph, poses)
    assert not (solution.weights[~right] > 0).any() and (solution.weights[right] > 0).mean() > 0.9
    np.testing.assert_allclose(solution.world_from_cam[0], poses[0], atol=1e-9)
    assert np.abs(solution.world_from_cam[:, :3, 3] - poses[:, :3, 3]).max() < 0.1
    assert "left out by the diagnosis" in solution.notes[0]


def test_a_round_is_judged_before_its_solve_and_solved_with_what_is_kept(tmp_path: Path) -> None:
    """Plain least squares: a wrong loop that the solve used would bend the ring."""
    poses = poses_on_a_ring(20)
    graph, right = spoiled(measured(poses, near_pairs(20, 4)), np.array([7, 31]))
    columns = {name: getattr(graph, name) for name in MEASURED}
    edges = replace(Edges.of(graph.edges), status=np.full(graph.edge_count, USED), **columns)
    step = Step(tmp_path, no_progress, lambda *notes: None)
    judged = judge_edges(edges, graph.vertex_ids, QUICK, step=step)
    assert set(judged.verdict[~right].tolist()) == {WRONG}
    registered = Registered("round 1", judged, np.zeros(0, np.int64), poses, poses)
    plain = PoissonSolver()
    bent, kept, forced = (
        solve_edges(one, graph.vertex_ids, plain, how, None, None, None, step=step)
        for one, how in (
            (registered, "all"), (registered, "kept"), (replace(registered, right=~right), "kept"),
        )
    )  # fmt: skip
    assert kept.solution is not None and forced.solution is not None
    assert (kept.solution.weights[~right] == 0).all() and set(kept.edges.status[~right].tolist()) == {IGNORED}
    assert (forced.solution.weights[~right] > 0).all(), "what a person calls right is solved with"
    off = [np.abs(one.world_from_cam[:, :3, 3] - poses[:, :3, 3]).max() for one in (bent, kept)]
    assert off[1] < 0.1 < off[0]


def chain(count: int) -> ViewGraph:
    k = np.arange(count)
    return measured(poses_on_a_ring(count), np.stack([k[:-1], k[1:]], axis=1))


def test_the_missing_side_of_two_untestable_edges_is_suggested_first() -> None:
    """0 - 1 - 2 and a triangle 2 - 3 - 4: the pair (0, 2) would test both bridges."""
    graph = measured(poses_on_a_ring(5), np.array([[0, 1], [1, 2], [2, 3], [3, 4], [2, 4]]))
    found = diagnose(graph, QUICK)
    assert (found.verdict == UNTESTABLE).tolist() == [True, True, False, False, False]
    suggestions = suggest_pairs(graph, found)
    assert suggestions.pairs[0].tolist() == [0, 2] and suggestions.tests[0] == 2
    assert suggestions.resistance[0] == 2 and "tests 2 untestable edges" in suggestions.reason[0]
    joined = {tuple(sorted(edge)) for edge in graph.edges.tolist()}
    assert not joined & {tuple(pair) for pair in suggestions.pairs.tolist()}


def test_missing_sides_of_triangles_are_all_of_a_usual_graph_and_few_of_a_view_that_sees_all() -> None:
    """Pairs of 50,000 neighbours of one view filled 24 GB."""
    edges = np.array([[0, 3], [3, 1], [1, 0], [4, 3], [2, 4], [2, 2]])
    joined = np.zeros((5, 5), int)
    joined[tuple(edges.T)] = joined[tuple(edges.T[::-1])] = 1
    brute = {(i, j) for i in range(5) for j in range(i + 1, 5) if joined[i] @ joined[j]}
    assert {tuple(pair) for pair in _missing_sides(edges, 5).tolist()} == brute
    hub = np.stack([np.zeros(1000, int), np.arange(1, 1001)], axis=1)
    assert 0 < len(_missing_sides(hub, 1001)) <= NEIGHBOURS_APART * 1000


def test_an_edge_that_is_added_takes_its_suggestion_away_and_the_ends_of_a_loop_come_first() -> None:
    """Eight steps are too few for a backbone, which a single loop would not be kept against."""
    graph = chain(9)
    found = diagnose(graph, QUICK)
    suggestions = suggest_pairs(graph, found, most=50)
    assert np.bincount(suggestions.pairs.ravel()).max() <= 2, "no view is named more than twice"
    assert (np.diff(suggestions.score) <= 0).all()
    far = suggestions.resistance.argmax()
    i, j = suggestions.pairs[far]
    assert j - i >= 7
    closed = ViewGraph.from_edges(
        graph.vertex_ids,
        np.concatenate([graph.edges, [[i, j]]]),
        np.concatenate([graph.i_from_j, (se3.inverse(poses_on_a_ring(9)[i]) @ poses_on_a_ring(9)[j])[None]]),
    )
    found = diagnose(closed, QUICK)
    assert found.kept.all()
    again = suggest_pairs(closed, found, most=50)
    assert [i, j] not in again.pairs.tolist()
    assert again.resistance.max() < suggestions.resistance.max()


def test_pieces_are_suggested_to_be_joined_and_nothing_needs_nothing() -> None:
    graph = measured(poses_on_a_ring(6), np.array([[0, 1], [1, 2], [0, 2], [3, 4], [4, 5], [3, 5]]))
    suggestions = suggest_pairs(graph, diagnose(graph, QUICK))
    assert suggestions.pairs.tolist() == [[2, 3]] and np.isinf(suggestions.resistance[0])
    assert "joins two pieces" in suggestions.reason[0]
    whole = measured(poses_on_a_ring(3), np.array([[0, 1], [1, 2], [0, 2]]))
    assert len(suggest_pairs(whole, diagnose(whole, QUICK)).pairs) == 0


def test_an_edge_that_the_diagnosis_keeps_and_the_poses_refute_is_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """The gate is for the edge's own residual; weights are what the information is multiplied by in the last solve."""
    graph = measured(poses_on_a_ring(20), near_pairs(20, 4))
    motion = graph.i_from_j.copy()
    motion[7] = motion[7] @ se3.exp(15 * SIGMA * np.array([1.0, 0, 0, 0, 0, 0]))
    information = np.tile(np.diag(SIGMA**-2), (graph.edge_count, 1, 1))
    graph = replace(graph, i_from_j=motion, information=information)
    everything = np.ones(graph.edge_count, bool)
    verdict = np.full(graph.edge_count, "consistent")
    known = replace(diagnose(graph, QUICK), kept=everything, verdict=verdict)
    monkeypatch.setattr("hodge_pipeline.diagnosis.robust.backbone_or_diagnosis", lambda *_: known)
    solution = RobustSolver(diagnosis=QUICK).solve(graph, poses_on_a_ring(20))
    assert solution.weights[7] == 0 and (np.delete(solution.weights, 7) > 0).all()
    weighted = replace(graph, information=solution.weights[:, None, None] * graph.information)
    again = solve(weighted, start=solution.world_from_cam)
    np.testing.assert_allclose(again.metrics["chi2"], solution.metrics["chi2"], rtol=1e-8)


def test_a_whole_turn_hidden_in_a_ring_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where pieces grew with a turn of 2π spread over 200 edges, each of them agrees: the ring was 3 m off."""
    count, sigma = 200, np.repeat([0.08, 0.02], 3)
    truth, edges = poses_on_a_ring(count), near_pairs(count, 3)
    errors = se3.exp(np.random.default_rng(0).normal(size=(len(edges), 6)) * sigma)
    motion = se3.inverse(truth[edges[:, 0]]) @ truth[edges[:, 1]] @ errors
    graph = ViewGraph.from_edges(np.arange(count), edges, motion, np.tile(np.diag(sigma**-2), (len(edges), 1, 1)))
    ahead = (se3.inverse(truth[0]) @ truth[1])[:3, 3]
    turn = np.outer(2 * np.pi * np.arange(count) / count, ahead / np.linalg.norm(ahead))
    twisted = Alignment(np.zeros(count, np.int64), truth @ se3.from_parts(se3.so3_exp(turn), np.zeros((count, 3))))
    monkeypatch.setattr("hodge_pipeline.diagnosis.consensus.align", lambda *_: twisted)
    found = diagnose(graph, DiagnosisOptions(trust="none"))
    assert found.kept.all()
    assert Drive(graph, truth, found.kept).error_m(found.world_from_cam) < 0.5
