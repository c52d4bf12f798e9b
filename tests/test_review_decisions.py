"""The decisions of a review: their file, their log, and who may take them."""

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import review_data
from hodge_pipeline.errors import GraphError
from hodge_pipeline.pairs.edits import Edit, History, read_history, write_history
from hodge_pipeline.review.decisions import LockedError, StaleError
from hodge_pipeline.review.keeping import save
from hodge_pipeline.review.listing import state
from hodge_pipeline.review.session import Session
from hodge_pipeline.review.subject import open_for_review
from review_data import PLANTED, revision

graph_file, session = review_data.graph_file, review_data.session


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
    assert session.decisions.history == read_history(session.subject.edits) == kept


def test_edits_of_another_program_are_taken_over_not_written_over(session: Session) -> None:
    other = History((Edit(disable=("0-1",)),))
    write_history(session.subject.edits, other)
    with pytest.raises(StaleError, match="another program"):
        session.decide(revision(session), "disable", [1])
    assert read_history(session.subject.edits) == other == session.decisions.history
    session.undo(revision(session))
    assert read_history(session.subject.edits).switches == {}


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


def test_words_that_are_no_decision_are_refused(session: Session) -> None:
    for verb, rows in (("burn", [1]), ("disable", []), ("disable", [10_000])):
        with pytest.raises(GraphError, match="expected"):
            session.decide(revision(session), verb, rows)
    assert not session.subject.edits.exists()


def test_a_graph_is_saved_beside_the_old_one_and_nothing_is_written_over(session: Session) -> None:
    before = session.subject.path.read_bytes()
    session.disable_wrong(revision(session))
    session.wait()
    (first, _), (second, _) = save(session), save(session)
    assert [first.name, second.name] == ["ring.reviewed.g2o", "ring.reviewed-2.g2o"]
    assert session.subject.path.read_bytes() == before
    assert read_history(first.with_name(first.name + ".edits.json")) == session.decisions.history
    saved = open_for_review(first)
    assert saved.graph.edge_count == len(session.table) - len(PLANTED)
    assert np.allclose(saved.source.trajectory.world_from_cam, session.settled.world_from_cam, atol=1e-6)  # type: ignore[union-attr]


def test_a_cell_of_the_log_is_no_formula(session: Session) -> None:
    session.decide(revision(session), "disable", [1], "=HYPERLINK()")
    with session.subject.log.open() as file:
        assert [row["note"] for row in csv.DictReader(file)] == ["'=HYPERLINK()"]


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
