"""A review without a browser: decisions, what follows from them, and who is let in."""

import csv
import http.client
import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from threading import Event
from typing import Any

import numpy as np
import pytest

import hodge_pipeline
from diagnosis_graphs import measured, near_pairs, poses_on_a_ring, spoiled
from hodge_adapters.pose_graphs.g2o import write_g2o
from hodge_pipeline import se3
from hodge_pipeline.errors import GraphError, WorkspaceError
from hodge_pipeline.pairs.edits import Edit, History, pair_names, read_history_file, write_history_file
from hodge_pipeline.recipe.schema import load_recipe
from hodge_pipeline.review import session as review_session
from hodge_pipeline.review.adding import Candidate, guess_from_points
from hodge_pipeline.review.decisions import LockedError, StaleError
from hodge_pipeline.review.front import Front
from hodge_pipeline.review.keeping import save
from hodge_pipeline.review.listing import Query, describe, list_edges, state
from hodge_pipeline.review.picking import nearest_point, nearest_segment
from hodge_pipeline.review.routes import site
from hodge_pipeline.review.session import Session
from hodge_pipeline.review.settle import Settler, moved_m
from hodge_pipeline.review.subject import open_for_review
from hodge_pipeline.rounds.one_round import with_right
from hodge_pipeline.solvers.editing import GraphEditor
from hodge_pipeline.types import CloudSet

VIEWS, REACH, PLANTED = 24, 3, (5, 40)
"""A ring of views, each joined to the next three; two of these edges have another motion."""


@pytest.fixture
def graph_file(tmp_path: Path) -> Path:
    poses = poses_on_a_ring(VIEWS)
    graph, _ = spoiled(measured(poses, near_pairs(VIEWS, REACH)), np.array(PLANTED))
    write_g2o(tmp_path / "ring.g2o", graph, poses)
    return tmp_path / "ring.g2o"


@pytest.fixture
def session(graph_file: Path) -> Iterator[Session]:
    opened = Session(open_for_review(graph_file), who="ada", now=lambda: "2026-01-01T00:00:00Z")
    opened.wait()
    yield opened
    opened.close()


def revision(session: Session) -> int:
    return session.decisions.revision


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


def test_nothing_is_lost_when_the_program_ends(session: Session, graph_file: Path) -> None:
    session.decide(revision(session), "disable", [PLANTED[0]])
    session.decide(revision(session), "right", [3])
    again = Session(open_for_review(graph_file), who="grace")
    again.wait()
    assert again.decisions.history == session.decisions.history
    assert again.settled.weights[PLANTED[0]] == 0
    again.undo(revision(again))
    assert again.decisions.history.switches == {session.names([PLANTED[0]])[0]: "disabled"}
    again.close()


def test_a_stale_revision_changes_nothing(session: Session) -> None:
    seen = revision(session)
    session.decide(seen, "disable", [1])
    kept = session.decisions.history
    with pytest.raises(StaleError, match="another page has decided"):
        session.decide(seen, "disable", [2])
    assert session.decisions.history == read_history_file(session.subject.edits) == kept


def test_edits_of_another_program_are_taken_over_not_written_over(session: Session) -> None:
    other = History((Edit(disable=("0-1",)),))
    write_history_file(session.subject.edits, other)
    with pytest.raises(StaleError, match="another program"):
        session.decide(revision(session), "disable", [1])
    assert read_history_file(session.subject.edits) == other == session.decisions.history
    session.undo(revision(session))
    assert read_history_file(session.subject.edits).switches == {}


def test_redo_restores_what_was_undone_last_and_is_gone_after_a_new_decision(session: Session) -> None:
    for row in (1, 2):
        session.decide(revision(session), "disable", [row])
    session.undo(revision(session))
    session.decide(revision(session), "disable", [3])
    with pytest.raises(GraphError, match="nothing to redo"):
        session.redo(revision(session))
    session.undo(revision(session))
    session.redo(revision(session))
    assert session.decisions.history.disabled == tuple(sorted(session.names([1, 3])))


def test_a_decision_that_leaves_no_edge_is_told_and_the_poses_stay(session: Session) -> None:
    before = session.settled.world_from_cam
    session.decide(revision(session), "disable", list(range(len(session.table))))
    session.wait()
    assert "no edge would count" in session.message
    assert session.settled.world_from_cam is before


def test_words_that_are_no_decision_are_refused(session: Session) -> None:
    for verb, rows in (("burn", [1]), ("disable", []), ("disable", [10_000])):
        with pytest.raises(GraphError, match="expected"):
            session.decide(revision(session), verb, rows)
    assert not session.subject.edits.exists()


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


def test_a_graph_is_saved_beside_the_old_one_and_nothing_is_written_over(session: Session) -> None:
    before = session.subject.path.read_bytes()
    session.disable_wrong(revision(session))
    session.wait()
    (first, _), (second, _) = save(session), save(session)
    assert [first.name, second.name] == ["ring.reviewed.g2o", "ring.reviewed-2.g2o"]
    assert session.subject.path.read_bytes() == before
    assert read_history_file(first.with_name(first.name + ".edits.json")) == session.decisions.history
    saved = open_for_review(first)
    assert saved.graph.edge_count == len(session.table) - len(PLANTED)
    assert np.allclose(saved.source.trajectory.world_from_cam, session.settled.world_from_cam, atol=1e-6)  # type: ignore[union-attr]


def test_a_cell_of_the_log_is_no_formula(session: Session) -> None:
    session.decide(revision(session), "disable", [1], "=HYPERLINK()")
    with session.subject.log.open() as file:
        assert [row["note"] for row in csv.DictReader(file)] == ["'=HYPERLINK()"]


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


def test_a_port_in_use_is_one_line(session: Session) -> None:
    front = Front(site(session))
    with pytest.raises(WorkspaceError, match="give another --port"):
        Front(site(session), front.port)
    front.close()


class Client:
    """Asks a front as a browser or a stranger would."""

    def __init__(self, session: Session) -> None:
        self.front = Front(site(session))
        self.host = f"127.0.0.1:{self.front.port}"

    def ask(self, method: str, name: str, body: Any = None, *, token: str = "", **headers: str) -> tuple[int, Any]:
        connection = http.client.HTTPConnection(self.host, timeout=20)
        path = f"/{token or self.front.token}/{name}"
        connection.request(method, path, None if body is None else json.dumps(body), headers)
        answer = connection.getresponse()
        text = answer.read()
        connection.close()
        return answer.status, json.loads(text) if answer.getheader("Content-Type") == "application/json" else text


@pytest.fixture
def client(session: Session) -> Iterator[Client]:
    made = Client(session)
    yield made
    made.front.close()


def test_a_stranger_gets_nothing(client: Client, session: Session) -> None:
    before = session.decisions.history
    mine = {"revision": 0, "verb": "disable", "rows": [1]}
    for headers in (
        {"token": "guessed"},
        {"token": client.front.token[:-1]},
        {"Origin": "http://evil.example"},
        {"Origin": "null"},
        {"Origin": f"http://127.0.0.1:{client.front.port + 1}"},
        {"Host": "evil.example"},
        {"Host": f"evil.example:{client.front.port}"},
    ):
        for method, name, body in (("GET", "state", None), ("GET", "scene/", None), ("POST", "decide", mine)):
            status, text = client.ask(method, name, body, **headers)
            assert (status, text) == (403, b"forbidden\n"), (headers, name)
    status, _ = client.ask("GET", "scene", Upgrade="websocket", Connection="Upgrade", Origin="http://evil.example")
    assert status == 403
    assert session.decisions.history == before
    assert client.ask("GET", "state", Origin=f"http://{client.host}")[0] == 200


def test_the_front_listens_on_this_machine_alone(client: Client) -> None:
    assert client.front._server.server_address[0] == "127.0.0.1"


def test_two_pages_and_a_stale_write_through_the_front(client: Client) -> None:
    _, seen = client.ask("GET", "state")
    wish = {"revision": seen["revision"], "verb": "disable"}
    status, found = client.ask("POST", "decide", wish | {"rows": [1]})
    assert status == 200 and found["state"]["revision"] == seen["revision"] + 1
    status, refused = client.ask("POST", "decide", wish | {"rows": [2]})
    assert status == 409 and "look again" in refused["error"]
    assert client.ask("GET", "state")[1]["revision"] == seen["revision"] + 1


@pytest.mark.parametrize(
    ("method", "name", "body"),
    [
        ("POST", "decide", {"revision": 0, "verb": "disable", "rows": "all"}),
        ("POST", "decide", {"verb": "disable", "rows": [1]}),
        ("POST", "decide", ["disable"]),
        ("POST", "look", {"mode": "sideways"}),
        ("POST", "look", {"share": "half"}),
        ("POST", "look", {"share": float("nan")}),
        ("POST", "look", {"cut": [1]}),
        ("POST", "look", {"verdicts": 3}),
        ("POST", "select", {"row": float("inf")}),
        ("POST", "select", {"row": 10_000}),
        ("POST", "pick", {"frames": ["nobody"]}),
        ("POST", "register", {}),
        ("POST", "accept", {"revision": 0}),
        ("GET", "edges?sort=taste", None),
        ("GET", "edges?min_gap=wide", None),
        ("GET", "edges?colour=red", None),
        ("GET", "edge?row=-3", None),
        ("GET", "picture?row=1&number=7", None),
    ],
)
def test_what_makes_no_sense_is_refused_in_one_line(client: Client, method: str, name: str, body: Any) -> None:
    status, answer = client.ask(method, name, body)
    assert status == 400 and answer["error"] and "\n" not in answer["error"]


def test_a_body_too_large_is_not_read(client: Client) -> None:
    status, answer = client.ask("POST", "decide", {"note": "x" * 300_000})
    assert status == 400 and "bytes" in answer["error"]


def test_a_run_that_is_running_can_only_be_looked_at(session: Session, tmp_path: Path) -> None:
    from hodge_pipeline.review.decisions import Decisions, LogEntry
    from hodge_pipeline.store.workspace import holding

    decisions = Decisions(tmp_path / "edits.json", tmp_path / "log.csv", run_folder=tmp_path)
    with holding(tmp_path):
        assert "another run uses this folder" in decisions.why_locked()
        with pytest.raises(LockedError, match="can only be looked at"):
            decisions.add(0, Edit(disable=("1-2",)), LogEntry())
    assert decisions.why_locked() == "" and not (tmp_path / "edits.json").exists()
    locked = replace(session.subject, locked="the run is not finished")
    looking = Session(locked)
    with pytest.raises(LockedError, match="not finished"):
        looking.decide(0, "disable", [1])
    assert state(looking)["locked"] == "the run is not finished"
    looking.close()


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
    write_history_file(run.edits, History((before,)))
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
