"""A loop with one wrong edge and nobody to say which: nothing of it is called consistent, and the loop is named."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner

from diagnosis_graphs import measured, near_pairs, poses_on_a_ring, spoiled
from hodge_adapters.pose_graphs.g2o import write_g2o
from hodge_pipeline import se3
from hodge_pipeline.cli.main import app
from hodge_pipeline.complex import short_cycles
from hodge_pipeline.complex.series import series_classes
from hodge_pipeline.diagnosis.diagnosis import diagnose
from hodge_pipeline.diagnosis.options import DiagnosisOptions
from hodge_pipeline.diagnosis.result import CONSISTENT, SUSPECT, UNTESTABLE, WRONG, Diagnosis
from hodge_pipeline.diagnosis.wording import TOO_LONG
from hodge_pipeline.solvers.backbone.trust import NONE
from hodge_pipeline.types import ViewGraph

CHAIN = [(k, k + 1) for k in range(9)]


def graph_of(*more: tuple[int, int], bad: int) -> ViewGraph:
    """0 - 1 - … - 9 and more edges, of which that of row `bad` among all is wrong."""
    poses, edges = poses_on_a_ring(10), np.array([*CHAIN, *more])
    return spoiled(measured(poses, edges), np.array([bad]))[0]


@pytest.mark.parametrize(
    ("second", "shared", "loop"),
    [
        ((8, 1), {(8, 9), (9, 0), (0, 1)}, "8-9-0-1"),
        ((4, 0), {(4, 5), (5, 6), (6, 7), (7, 8), (8, 9), (9, 0)}, "6-7-8-9-0-4-5"),
    ],
)
def test_a_good_loop_vouches_for_its_own_edges_alone(
    second: tuple[int, int], shared: set[tuple[int, int]], loop: str
) -> None:
    graph = graph_of((9, 0), second, bad=9)
    found = diagnose(graph)
    for row, ends in enumerate(map(tuple, graph.edges.tolist())):
        if ends in shared:
            assert found.verdict[row] in (UNTESTABLE, SUSPECT), "one of them is wrong, and nothing says which"
            assert f"the loop {loop} fails by" in found.reason[row]
            assert not found.probability[row] < 0.5, "a right edge is not called improbable for nothing"
        else:
            assert found.verdict[row] == CONSISTENT
    assert sorted(set(found.verdict.tolist())) == [CONSISTENT, SUSPECT, UNTESTABLE]
    left_out = found.verdict == SUSPECT
    assert ((found.probability[left_out] > 0.5) & (found.probability[left_out] < 1)).all(), "one of several is wrong"


def test_a_second_loop_through_the_wrong_edge_clears_the_others() -> None:
    graph = graph_of((9, 0), (8, 0), (9, 1), bad=9)
    found = diagnose(graph)
    assert found.verdict[9] == WRONG and (np.delete(found.verdict, 9) == CONSISTENT).all()


def test_the_command_says_so_and_what_to_register(tmp_path: Path) -> None:
    write_g2o(tmp_path / "chain.g2o", graph_of((9, 0), (8, 1), bad=9), poses_on_a_ring(10))
    done = CliRunner().invoke(app, ["diagnose", str(tmp_path / "chain.g2o"), "--verbose"], catch_exceptions=False)
    details, short = done.stdout.rsplit("verdict  ", 1)
    lines = short.splitlines()
    assert "1 of 11 edges is suspect; 2 may be to blame for the loop 8-9-0-1, which" in lines[0]
    assert {line.split()[1] for line in lines[2:5]} == {"8-9", "9-0", "0-1"}
    assert all("the loop 8-9-0-1 fails by" in line for line in lines[2:5])
    assert any(line.startswith("register 1-9 tests 1 untestable edge;") for line in details.splitlines())


SQUARES = [(0, 1), (1, 2), (2, 3), (3, 0), (3, 4), (4, 5), (5, 2)]
"""0 - 1 - 2 - 5 - 4 - 3 - 0 with 2 - 3 across: two squares that share a side."""
THETA = [(0, 1), (1, 2), (2, 7), (0, 3), (3, 4), (4, 7), (0, 5), (5, 6), (6, 7)]
"""Three ways of three edges from 0 to 7."""


def verdicts(edges: list[tuple[int, int]], *bad: int) -> tuple[ViewGraph, Diagnosis]:
    graph = measured(poses_on_a_ring(1 + max(map(max, edges))), np.array(edges))
    graph = spoiled(graph, np.array(bad))[0]
    return graph, diagnose(graph)


def test_one_edge_that_explains_two_loops_is_blamed_and_the_loop_without_it_is_listed() -> None:
    graph, found = verdicts(SQUARES, 2)
    assert found.verdict[2] == WRONG and (np.delete(found.verdict, 2) == CONSISTENT).all()
    assert all(reason.startswith("1 of 2 cycles close") for reason in np.delete(found.reason, 2))


@pytest.mark.parametrize(
    ("edges", "bad", "mates"),
    [(SQUARES, 0, {0, 1, 3}), (THETA, 0, {0, 1, 2}), (THETA, 4, {3, 4, 5}), ([*THETA, (0, 8), (8, 7)], 9, {9, 10})],
)
def test_edges_in_series_share_the_blame_and_no_other_does(
    edges: list[tuple[int, int]], bad: int, mates: set[int]
) -> None:
    graph, found = verdicts(edges, bad)
    doubted = set(np.flatnonzero(found.verdict != CONSISTENT).tolist())
    assert doubted == mates and set(found.verdict[sorted(mates)].tolist()) == {SUSPECT, UNTESTABLE}
    names = ", ".join(f"{i}-{j}" for i, j in graph.edges[sorted(mates)].tolist())
    assert all(f"one of {names} is wrong, and no other cycle says which" in found.reason[row] for row in mates)
    assert found.piece.max() == 0, "one edge out of a loop leaves the graph in one piece"


def test_a_wrong_step_under_two_good_loops_leaves_both_loops_alone() -> None:
    graph = graph_of((9, 0), (7, 2), bad=4)
    found = diagnose(graph)
    assert set(found.verdict[[9, 10]].tolist()) == {CONSISTENT}
    assert set(np.flatnonzero(found.verdict != CONSISTENT).tolist()) == {2, 3, 4, 5, 6}, "2 - 3 - … - 7 are in series"


def test_one_far_likelier_wrong_than_the_others_of_its_only_loop_is_no_tie() -> None:
    """Edges over one step and over five are right, and those over two wrong, one of them in a triangle at the end."""
    count, two = 40, [*((k, k + 2) for k in range(0, 34, 2)), (37, 39)]
    edges = np.array([*((k, k + 1) for k in range(count - 1)), *((k, k + 5) for k in range(33)), *two])
    wrong = np.arange(len(edges) - len(two), len(edges))
    graph = spoiled(measured(poses_on_a_ring(count), edges), wrong)[0]
    found = diagnose(graph, DiagnosisOptions(trust=NONE))
    assert (found.verdict[wrong] == WRONG).all() and not found.kept[wrong].any() and found.kept.sum() == 72
    assert found.verdict[37:39].tolist() == [UNTESTABLE, UNTESTABLE]
    assert "one of its 3 edges is wrong, and edges as far apart as this one often are" in found.reason[-1]


def test_edges_in_series_are_those_of_the_same_cycles() -> None:
    edges = np.array([*SQUARES, (5, 6), (6, 6), (0, 1)])
    classes = series_classes(edges, 7)
    groups = {frozenset(np.flatnonzero(classes == name).tolist()) for name in set(classes.tolist()) - {-1}}
    assert groups == {frozenset(rows) for rows in ({0}, {1, 3}, {2}, {4, 5, 6}, {8}, {9})}
    assert np.flatnonzero(classes == -1).tolist() == [7], "a bridge is in no cycle"


@given(seed=st.integers(0, 10_000))
def test_edges_in_series_fall_into_bridges_when_one_is_taken_out(seed: int) -> None:
    rng = np.random.default_rng(seed)
    edges = rng.integers(0, 8, (11, 2))
    classes = series_classes(edges, 8)
    for row in range(len(edges)):
        without = series_classes(np.delete(edges, row, axis=0), 8)
        new_bridges = np.flatnonzero((without == -1) & (np.delete(classes, row) != -1))
        mates = np.flatnonzero((np.delete(classes, row) == classes[row]) & (classes[row] != -1))
        np.testing.assert_array_equal(new_bridges, mates)


def stated(graph: ViewGraph, deviation_rad: float, deviation_m: float) -> ViewGraph:
    information = np.diag(1 / np.repeat([deviation_rad, deviation_m], 3) ** 2)
    return replace(graph, information=np.tile(information, (graph.edge_count, 1, 1)))


@pytest.mark.parametrize(("deviation_rad", "deviation_m"), [(0.5, 1.0), (0.1, 0.2), (0.005, 0.01), (5e-5, 1e-4)])
def test_a_bad_loop_is_seen_whatever_the_information_states(deviation_rad: float, deviation_m: float) -> None:
    found = diagnose(stated(graph_of((9, 0), bad=9), deviation_rad, deviation_m))
    assert set(found.verdict.tolist()) == {UNTESTABLE}
    assert all("the loop 5-6-7-8-9-0-1-2-3-4 fails by" in reason for reason in found.reason)
    doubted = deviation_rad != 0.005
    assert any("the information states errors that" in note for note in found.notes) == doubted


def test_a_good_loop_closes_though_the_information_states_errors_far_too_large() -> None:
    good = measured(poses_on_a_ring(10), np.array([*CHAIN, (9, 0)]))
    assert (diagnose(stated(good, 0.5, 1.0)).verdict == CONSISTENT).all()
    dense = measured(poses_on_a_ring(12), near_pairs(12, 3))
    spoilt, right = spoiled(dense, np.array([20]))
    found = diagnose(stated(spoilt, 0.5, 1.0))
    assert found.verdict[20] == WRONG and (found.verdict[right] == CONSISTENT).all()


def test_views_that_turn_about_one_point_are_not_held_to_exactness() -> None:
    """A ring in the plane, which all views look out of: at its middle nothing moves."""
    angle = 2 * np.pi * np.arange(10) / 10
    poses = se3.from_parts(
        se3.so3_exp(np.outer(angle, [0, 0, 1])), np.stack([3 * np.cos(angle), 3 * np.sin(angle), 0 * angle], axis=1)
    )
    graph = stated(measured(poses, np.array([*CHAIN, (9, 0)])), 0.5, 1.0)
    assert (diagnose(graph).verdict == CONSISTENT).all()


def test_a_wrong_edge_beside_a_right_one_is_not_disabled_by_the_name_of_both(tmp_path: Path) -> None:
    graph = spoiled(measured(poses_on_a_ring(4), np.array([(0, 1), (1, 2), (2, 3), (1, 2), (1, 2)])), np.array([3]))[0]
    write_g2o(tmp_path / "thrice.g2o", graph, poses_on_a_ring(4))
    done = CliRunner().invoke(app, ["diagnose", str(tmp_path / "thrice.g2o")], catch_exceptions=False)
    assert (
        "1 of 5 edges is wrong, worst of all 1–2; 2 lie in no loop, so that\n         nothing can test them.\n"
        in done.stdout
    )
    assert "a right one joins the same two views (1-2)" in done.stdout and "--disable" not in done.stdout


def test_nothing_left_over_is_said_so_and_not_shared_out(tmp_path: Path) -> None:
    exact = measured(poses_on_a_ring(4), near_pairs(4, 1), noise=0.0)
    write_g2o(tmp_path / "exact.g2o", exact, poses_on_a_ring(4))
    done = CliRunner().invoke(app, ["diagnose", str(tmp_path / "exact.g2o"), "--verbose"], catch_exceptions=False)
    assert "energy   rotation none, nothing is left over; translation none" in done.stdout
    assert "to 0 m, 0°; 0 m, 0° from the poses" in done.stdout and "e-1" not in done.stdout


def test_an_edge_alone_cannot_be_tested(tmp_path: Path) -> None:
    single = measured(poses_on_a_ring(2), np.array([(0, 1)]))
    write_g2o(tmp_path / "single.g2o", single, poses_on_a_ring(2))
    done = CliRunner().invoke(app, ["diagnose", str(tmp_path / "single.g2o")], catch_exceptions=False)
    assert "1 of 1 edges lies in no loop, so that nothing can test it" in done.stdout
    assert "information states" not in done.stdout


def test_a_few_frames_of_a_camera_that_only_turns_are_not_blamed_for_moving_little() -> None:
    """Their steps are a centimetre, and so are their errors, as the information states."""
    for seed in range(4):
        rng = np.random.default_rng(seed)
        poses = se3.exp(np.cumsum(rng.normal(size=(6, 6)) * np.repeat([0.15, 0.012], 3), axis=0))
        edges = np.array([(i, j) for i in range(6) for j in range(i + 1, min(i + 4, 6))])
        errors = se3.exp(rng.normal(size=(len(edges), 6)) * np.repeat([0.012, 0.008], 3))
        graph = ViewGraph.from_edges(np.arange(6), edges, se3.inverse(poses[edges[:, 0]]) @ poses[edges[:, 1]] @ errors)
        stated = np.diag(np.repeat([0.015, 0.007], 3) ** -2.0)
        found = diagnose(replace(graph, information=np.tile(stated, (len(edges), 1, 1))))
        assert found.kept.all()


def test_edges_of_a_loop_too_long_to_be_listed_are_told_from_those_of_none(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(short_cycles, "LONGEST_ENTRIES", 20)
    poses = poses_on_a_ring(31)
    ring = near_pairs(30, 1)
    graph = measured(poses, np.concatenate([ring, [[0, 30]]]))
    found = diagnose(graph, DiagnosisOptions(trust=NONE))
    assert set(found.reason[:30]) == {TOO_LONG} and found.reason[30].startswith("no cycle passes it")
    path = tmp_path / "ring.g2o"
    write_g2o(path, graph, poses)
    done = CliRunner().invoke(app, ["diagnose", str(path), "--trust", NONE, "--out", str(tmp_path / "why")])
    said = " ".join(done.stdout.split())
    assert "1 of 31 edges lies in no loop, so that nothing can test it; 30 lie in loops too long" in said
