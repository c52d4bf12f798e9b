"""A review without a browser: what follows from decisions, what is listed, and what is picked and added."""

from dataclasses import replace
from pathlib import Path
from threading import Event
from typing import Any

import numpy as np
import pytest

import hodge_pipeline
import review_data
from diagnosis_graphs import measured, near_pairs, poses_on_a_ring
from hodge_adapters.pose_graphs.g2o import write_g2o
from hodge_pipeline import se3
from hodge_pipeline.errors import GraphError
from hodge_pipeline.pairs.edits import Edit, History, pair_names, write_history
from hodge_pipeline.recipe.schema import load_recipe
from hodge_pipeline.report.diagnosis_page import EdgePictures
from hodge_pipeline.report.document import Picture
from hodge_pipeline.review import routes
from hodge_pipeline.review import session as review_session
from hodge_pipeline.review.adding import Candidate, guess_from_points
from hodge_pipeline.review.listing import Query, describe, list_edges
from hodge_pipeline.review.picking import nearest_point, nearest_segment
from hodge_pipeline.review.session import Session
from hodge_pipeline.review.settle import Settler, moved_m
from hodge_pipeline.review.subject import open_for_review
from hodge_pipeline.rounds.one_round import with_right
from hodge_pipeline.solvers.editing import GraphEditor
from hodge_pipeline.types import CloudSet
from review_data import PLANTED, REACH, VIEWS, revision

graph_file, session = review_data.graph_file, review_data.session


def truth_error_m(session: Session) -> float:
    found = session.settled.world_from_cam
    first = poses_on_a_ring(VIEWS)
    relative = se3.inverse(found[:1]) @ found
    return float(np.abs(relative - se3.inverse(first[:1]) @ first)[:, :3, 3].max())


def test_disabling_the_planted_edges_mends_the_poses_and_undo_brings_them_back(session: Session) -> None:
    before = truth_error_m(session)
    session.disable_wrong(revision(session), "two desks")
    session.wait()
    mended = truth_error_m(session)
    assert mended < 0.2 * before
    assert set(np.flatnonzero(session.settled.weights == 0)) == set(PLANTED)
    session.undo(revision(session))
    session.wait()
    assert truth_error_m(session) == pytest.approx(before, rel=1e-3)
    session.redo(revision(session))
    session.wait()
    assert truth_error_m(session) == pytest.approx(mended, rel=1e-3)
    assert [line["decision"] for line in session.decisions.lines()] == ["disable", "undo disable", "redo disable"]
    assert session.decisions.lines()[0] | {"time": "", "residual_m": "", "residual_deg": "", "score": ""} == {
        "time": "", "who": "ada", "decision": "disable", "pairs": " ".join(session.names(PLANTED)),
        "verdict": "wrong", "score": "", "residual_m": "", "residual_deg": "", "note": "two desks",
    }  # fmt: skip


def test_verdicts_follow_and_what_is_off_keeps_its_own(session: Session) -> None:
    wrong = session.table.edges.verdict == "wrong"
    assert set(np.flatnonzero(wrong)) == set(PLANTED)
    session.decide(revision(session), "disable", [PLANTED[0]])
    session.wait()
    assert session.judged is not None and session.judged.row(PLANTED[0]) is None
    assert session.table.edges.verdict[PLANTED[0]] == "wrong"
    assert session.judged.row(PLANTED[1]) == PLANTED[1] - 1
    assert describe(session, PLANTED[1])["cycles"]


def test_poses_are_shown_before_they_are_checked_and_converge(graph_file: Path) -> None:
    settler = Settler(open_for_review(graph_file))
    settler.table = replace(settler.table, base=np.ones(len(settler.table)))
    history = History((Edit(disable=tuple(pair_names(np.arange(VIEWS), settler.table.graph.edges[list(PLANTED)]))),))
    settler._solution = replace(settler._solution, world_from_cam=np.tile(np.eye(4), (VIEWS, 1, 1)))
    settler._editor = GraphEditor(settler.table.graph, settler._solution)
    settler.settled = replace(settler.settled, world_from_cam=settler._solution.world_from_cam)
    first, then = settler.solve(history, 1), settler.checked(history, 1)
    assert not first.converged and then is not None and then.converged
    assert then.residual_m[then.weights > 0].max() < first.residual_m[first.weights > 0].max()
    assert settler.checked(history, 1) is None
    assert then.moved_m == pytest.approx(moved_m(np.tile(np.eye(4), (VIEWS, 1, 1)), then.world_from_cam))


def test_a_decision_that_leaves_no_edge_is_told_and_the_poses_stay(session: Session) -> None:
    before = session.settled.world_from_cam
    session.decide(revision(session), "disable", list(range(len(session.table))))
    session.wait()
    assert "no edge would count" in session.message
    assert session.settled.world_from_cam is before


def test_the_table_is_filtered_and_sorted(session: Session) -> None:
    everything = list_edges(session, Query())
    assert everything["total"] == len(session.table) and [e["row"] for e in everything["edges"][:2]] == sorted(
        PLANTED, key=lambda row: -session.settled.residual_m[row]
    )
    gaps = [edge["gap"] for edge in list_edges(session, Query(sort="gap", descending=True))["edges"]]
    assert gaps == sorted(gaps)
    assert {edge["row"] for edge in list_edges(session, Query(verdicts=("wrong",)))["edges"]} == set(PLANTED)
    of_frame = list_edges(session, Query(frame="7"))["edges"]
    assert of_frame and all("7" in edge["name"].split("-") for edge in of_frame)
    far = list_edges(session, Query(min_residual_m=0.1))["edges"]
    assert 0 < len(far) < len(session.table) and all(edge["residual_m"] >= 0.1 for edge in far)
    some = list_edges(session, Query(first=10, count=5))["edges"]
    assert [edge["row"] for edge in some] == [edge["row"] for edge in everything["edges"][10:15]]


def test_where_nothing_is_wrong_every_edge_is_listed(tmp_path: Path, session: Session) -> None:
    assert session.look.verdicts == ("wrong", "suspect")
    poses = poses_on_a_ring(VIEWS)
    write_g2o(tmp_path / "good.g2o", measured(poses, near_pairs(VIEWS, REACH)), poses)
    good = Session(open_for_review(tmp_path / "good.g2o"), who="ada")
    try:
        good.wait()
        found = list_edges(good, Query(verdicts=good.look.verdicts))
        assert found["total"] == len(good.table) == VIEWS * REACH
    finally:
        good.close()


def test_the_whole_scene_is_seen_from_above_when_it_is_asked_for_again(session: Session) -> None:
    session.show(mode="edge")
    session.show(mode="all")
    session.select(3)
    assert (session.look.home, session.look.mode, session.look.selected) == (0, "all", 3)
    session.show(mode="all")
    assert session.look.home == 1


def test_three_points_give_the_motion_and_a_line_does_not() -> None:
    motion = se3.exp(np.array([0.3, -0.2, 0.9, 1.0, 2.0, 0.5]))
    points = np.array([[0.0, 0, 2], [1, 0, 3], [0, 1, 2.5]])
    assert np.allclose(guess_from_points(se3.transform(motion, points), points), motion)
    with pytest.raises(GraphError, match="on a line"):
        guess_from_points(points, np.array([[0.0, 0, 1], [0, 0, 2], [0, 0, 3]]))
    candidate = Candidate(0, 1, np.eye(4))
    for here, there in zip(se3.transform(motion, points).tolist(), points.tolist(), strict=True):
        candidate = candidate.clicked(tuple(here)).clicked(tuple(there))
    assert np.allclose(candidate.guess, motion)


def test_a_cloud_put_at_a_place_makes_the_guess(session: Session) -> None:
    session.pick([3, 9])
    there = session.settled.world_from_cam[3] @ se3.exp(np.array([0.1, 0.2, -0.3, 1.0, 2.0, 3.0]))
    session.place(there)
    assert session.candidate is not None and session.candidate.guess_by == "the place it was put at"
    assert np.allclose(se3.log(session.candidate.guess), [0.1, 0.2, -0.3, 1.0, 2.0, 3.0])


def test_the_nearest_line_in_front_is_picked() -> None:
    segments = np.array([[[-1.0, 0.05, 10], [1, 0.05, 10]], [[-1, 0, -5], [1, 0, -5]], [[-1, 3, 4], [1, 3, 4]]])
    origin, ahead = np.zeros(3), np.array([0.0, 0, 2])
    assert nearest_segment(origin, ahead, segments) == 0
    assert nearest_segment(origin, np.array([0.0, 1, 0]), segments) is None
    assert nearest_segment(origin, np.array([0.0, 3, 4]), segments) == 2
    assert nearest_point(origin, ahead, np.array([[0.0, 0, 9], [0.006, 0, 3], [0, 0, -1]])) == 1
    assert nearest_point(origin, ahead, np.zeros((0, 3))) is None


def test_an_edge_that_is_right_counts_though_the_solver_had_left_it_out(session: Session) -> None:
    graph = replace(session.table.graph, information=session.table.graph.information / 0.01**2)
    solution = hodge_pipeline.solve_robust(graph)
    out = np.flatnonzero(solution.weights <= 0)
    assert set(PLANTED) <= set(out.tolist())
    right = np.arange(graph.edge_count) == PLANTED[0]
    forced = with_right(graph, solution, right)
    assert forced.weights[PLANTED[0]] == 1 and (forced.weights[np.setdiff1d(out, PLANTED[:1])] == 0).all()
    assert with_right(graph, solution, ~right & (solution.weights > 0)) is solution


def test_an_edge_added_counts_until_it_is_undone(session: Session) -> None:
    count = len(session.table)
    motion = se3.inverse(poses_on_a_ring(VIEWS)[0]) @ poses_on_a_ring(VIEWS)[12]
    registration = hodge_pipeline.Registration(motion, np.eye(6) * 1e4, 0.8, 0.01, 500, 9, True)
    session.candidate = Candidate(0, 12, motion, found=registration)
    session.accept(revision(session), "seen by eye")
    session.wait()
    assert len(session.table) == count + 1 and session.settled.weights[count] == 1
    assert session.table.edges.verdict[count]
    ((pair, numbers),) = session.decisions.history.edits[-1].guesses
    assert pair == "0-12" and np.allclose(np.reshape(numbers, (4, 4)), motion)
    session.undo(revision(session))
    session.wait()
    assert session.settled.weights[count] == 0


def test_what_was_added_before_and_what_a_page_adds_meanwhile_are_registered_once_each(
    session: Session, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    poses, asked, gate = poses_on_a_ring(VIEWS), list[tuple[int, int]](), Event()
    motion = se3.inverse(poses[0]) @ poses[12]
    registration = hodge_pipeline.Registration(motion, np.eye(6) * 1e4, 0.8, 0.01, 500, 9, True)

    def register(_recipe: Any, _clouds: Any, wanted: Candidate) -> hodge_pipeline.Registration:
        asked.append((wanted.i, wanted.j))
        return registration

    monkeypatch.setattr(review_session, "register_candidate", register)
    recipe, clouds = load_recipe("demo", [], tmp_path), CloudSet.from_clouds([])
    run = replace(session.subject, path=tmp_path, recipe=recipe, clouds=clouds)
    before = Edit(register=("0-12",), guesses=(("0-12", tuple(motion.reshape(-1).tolist())),))
    write_history(run.edits, History((before,)))
    monkeypatch.setattr(review_session, "open_for_review", lambda _: run)
    for jobs in (session.slow, session.quick):  # as while a run is fused
        jobs.put("fusing", lambda: gate.wait() and None)
    session.reopen(tmp_path)
    session.candidate = Candidate(1, 13, motion, found=registration)
    session.accept(revision(session))
    session.candidate = Candidate(2, 14, motion)
    session.register()
    gate.set()
    session.wait()
    assert asked == [(0, 12), (2, 14)]
    assert [len(session.rows_of(pair)) for pair in ("0-12", "1-13")] == [1, 1]


def test_pictures_of_an_edge_are_made_anew_when_a_check_betters_poses_of_the_same_revision(
    session: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[float] = []

    def drawn(graph: Any, diagnosis: Any, rows: Any, *_: Any, **__: Any) -> tuple[EdgePictures, ...]:
        made.append(float(diagnosis.world_from_cam[1, 0, 3]))
        return (EdgePictures(int(rows[0]), (Picture("a", "b", b""),)),)

    monkeypatch.setattr(routes, "edge_pictures", drawn)
    pictures = routes.PictureCache(session)
    assert pictures.of(3) is pictures.of(3) and len(made) == 1
    poses = session.settled.world_from_cam.copy()
    poses[1, 0, 3] += 1
    session.settled = replace(session.settled, world_from_cam=poses)
    assert pictures.of(3) and made[1] == made[0] + 1
