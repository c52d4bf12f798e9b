"""The table of edges: how it grows by columns, what of it a solver gets, and that its file reads back."""

from __future__ import annotations

import csv
import tracemalloc
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from hodge_pipeline.errors import WorkspaceError
from hodge_pipeline.evaluation.residuals import with_residuals
from hodge_pipeline.pairs.edits import listed_edges
from hodge_pipeline.refine.given_poses import held_out_pairs
from hodge_pipeline.scene import Round
from hodge_pipeline.store import codec
from hodge_pipeline.store.edge_table import COLUMNS, read_edges, write_edges
from hodge_pipeline.types import Edges, Registration

IDS = np.array(["a", "b-1", "c", "d"])


def registration(x_m: float) -> Registration:
    motion = np.eye(4)
    motion[0, 3] = x_m
    return Registration(motion, 100 * np.eye(6), 0.9, 0.01, 50, 7, True)


def grown() -> Edges:
    """Four views a metre apart on a line; c-d is held out, a-d was rejected, a-b is 0.5 m too long and ignored.

    a --- b-1 --- c ~ ~ d
    """
    proposed = Edges.proposed(np.array([[2, 3], [2, 1], [0, 1], [3, 0]]), "overlap", np.array([0.1, 0.2, 0.3, 0.4]))
    held = proposed.select(proposed.pairs[:, 0] == 2).put(slice(None), status="held_out")
    found = proposed.select(proposed.pairs[:, 0] != 2)
    found = found.with_registrations([registration(1.5), registration(9.0), registration(1.0)])
    found = found.put(1, status="rejected", why="too little overlap")
    poses = np.tile(np.eye(4), (4, 1, 1))
    poses[:, 0, 3] = np.arange(4)
    return with_residuals(Edges.joined([found, held]), poses, np.array([0.0, 1.0]))


def test_proposals_are_turned_and_sorted_with_their_overlap() -> None:
    table = Edges.proposed(np.array([[2, 3], [2, 1], [0, 1]]), "overlap", np.array([0.1, 0.2, 0.3]))
    assert table.pairs.tolist() == [[0, 1], [1, 2], [2, 3]] and table.overlap.tolist() == [0.3, 0.2, 0.1]
    assert set(table.status) == {"candidate"} and np.isnan(table.i_from_j).all() and not table.counts.any()


def test_what_is_not_known_of_proposals_takes_no_memory() -> None:
    """Of millions of pairs that overlap some thousands are kept: motions and information take 416 bytes each."""
    pairs = np.column_stack([np.arange(100_000), np.arange(1, 100_001)])
    tracemalloc.start()
    table = Edges.proposed(pairs, "overlap")
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 200 * len(table)
    np.testing.assert_array_equal(table.select(slice(3)).information, np.full((3, 6, 6), np.nan))


def test_a_solver_gets_what_was_accepted_and_a_graph_keeps_what_is_off() -> None:
    table = grown()
    assert table.status.tolist() == ["ignored", "rejected", "used", "held_out"]
    assert table.pairs[table.counts].tolist() == [[0, 1], [1, 2]]
    np.testing.assert_allclose(table.residual_m, [0.5, np.nan, 0.0, np.nan])
    off = table.put(2, status="disabled")
    assert off.counts.tolist() == [True, False, False, False] and off.in_graph.tolist() == [True, False, True, False]
    again = with_residuals(off, np.tile(np.eye(4), (4, 1, 1)), np.array([1.0, 0.0]))
    assert again.status.tolist() == ["used", "rejected", "disabled", "held_out"]
    one = Round(table, IDS, np.tile(np.eye(4), (4, 1, 1)))
    assert one.graph.edges.tolist() == [[0, 1], [1, 2]] and one.graph.source.tolist() == ["overlap"] * 2
    assert one.edges.rejected_counts == {"too little overlap": 1}


def test_a_longer_word_is_not_cut_and_other_rows_stay() -> None:
    table = Edges.of([[0, 1], [1, 2]], "a").put(1, why="much longer than nothing", status="rejected", weight=2.0)
    assert table.why.tolist() == ["", "much longer than nothing"]
    assert table.status.tolist() == ["candidate", "rejected"]
    np.testing.assert_array_equal(table.weight, [np.nan, 2.0])


def test_columns_survive_their_file_with_the_names_of_the_vertices(tmp_path: Path) -> None:
    table = grown()
    codec.save(tmp_path, Round(table, IDS, np.tile(np.eye(4), (4, 1, 1))))
    again = codec.load(tmp_path, Round)
    assert again.vertex_ids.tolist() == IDS.tolist()
    for column in fields(Edges):
        np.testing.assert_array_equal(getattr(again.edges, column.name), getattr(table, column.name))


def test_the_table_that_people_read_reads_back(tmp_path: Path) -> None:
    """Edges come before the pairs that are none; unknown is empty."""
    table = grown().put(0, verdict="wrong", probability=0.25, why="1 of 2, cycles", residual_rad=np.pi / 2)
    write_edges(tmp_path / "edges.csv", table, IDS)
    with (tmp_path / "edges.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == ["i", "j", *COLUMNS]
    assert [(row["i"], row["j"], row["status"], row["why"]) for row in rows] == [
        ("a", "b-1", "ignored", "1 of 2, cycles"),
        ("b-1", "c", "used", ""),
        ("a", "d", "rejected", "too little overlap"),
        ("c", "d", "held_out", ""),
    ]
    assert rows[0]["residual_deg"] == "90" and rows[2]["residual_m"] == "" and rows[2]["fitness"] == "0.9"
    again, names = read_edges(tmp_path / "edges.csv")
    order = [0, 2, 1, 3]
    assert names[again.pairs].tolist() == IDS[table.pairs[order]].tolist()
    for name in COLUMNS.values():
        expected = getattr(table, name)[order]
        if expected.dtype.kind == "f":
            np.testing.assert_allclose(getattr(again, name), expected, rtol=1e-5)
        else:
            assert getattr(again, name).tolist() == expected.tolist()
    assert listed_edges(tmp_path).edges.status.tolist() == ["ignored", "used", "rejected"], (
        "nobody switches a pair that judges the result"
    )


def test_a_table_of_no_edges_reads_back_and_one_without_status_is_refused(tmp_path: Path) -> None:
    write_edges(tmp_path / "edges.csv", Edges.of([]), IDS)
    edges, names = read_edges(tmp_path / "edges.csv")
    assert len(edges) == len(names) == 0
    (tmp_path / "edges.csv").write_text("i,j,source\n0,1,given\n")
    with pytest.raises(WorkspaceError, match="has no column 'status'"):
        read_edges(tmp_path / "edges.csv")


def test_a_pair_held_out_judges_until_somebody_has_it_registered() -> None:
    first = Round(grown(), IDS, np.tile(np.eye(4), (4, 1, 1)))
    assert held_out_pairs([first]).tolist() == [[2, 3]]
    by_hand = Edges.of([[2, 3]], "by_hand").with_registrations([registration(1.0)])
    last = replace(first, edges=Edges.joined([first.edges, by_hand]))
    assert held_out_pairs([first, last]).tolist() == []
