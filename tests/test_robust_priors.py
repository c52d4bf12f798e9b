"""Priors of single poses in a robust solve: those that contradict the edges and most others do not count."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from backbone_graphs import Drive, drive
from hodge_adapters.pose_graphs.g2o import write_g2o
from hodge_pipeline import se3
from hodge_pipeline.diagnosis.diagnosis import diagnose
from hodge_pipeline.diagnosis.robust import solve_robust
from hodge_pipeline.refine.pose_graph import SolveOptions, solve_file
from hodge_pipeline.solvers.maximum_likelihood import solve
from hodge_pipeline.types import Floats, Priors

FIX_M = 0.3


def with_fixes(made: Drive, off: Floats) -> Drive:
    """The graph with a satellite fix at every tenth pose, moved by `off (P, 3)`."""
    at, rng = np.arange(0, made.graph.vertex_count, 10), np.random.default_rng(3)
    spatial = made.graph.dimension == 3
    places = made.truth[at, :3, 3] + rng.normal(0, FIX_M, (len(at), 3)) * [1, 1, spatial] + off
    information = np.tile(np.diag([0, 0, 0, 1, 1, float(spatial)]) / FIX_M**2, (len(at), 1, 1))
    known = se3.from_parts(np.broadcast_to(np.eye(3), (len(at), 3, 3)), places)
    return replace(made, graph=replace(made.graph, priors=Priors(at, known, information)))


def far_off(count: int, share: float) -> Floats:
    """Shifts (P, 3) along the ground of a share of them, by 10 to 50 m."""
    rng = np.random.default_rng(4)
    turn, far_m = (
        rng.uniform(0, 2 * np.pi, count),
        rng.uniform(10, 50, count) * (rng.permutation(count) < share * count),
    )
    return np.stack([far_m * np.cos(turn), far_m * np.sin(turn), np.zeros(count)], axis=1)


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("share", [0.025, 0.2, 0.4])
def test_wrong_fixes_do_not_bend_the_poses(dimension: int, share: float) -> None:
    """All counted: three metres off in space, where odometry was 1.6 off, and "Solved"."""
    made = drive(dimension=dimension, world="town", seed=2, wrong=0.3, loops=60)
    off = far_off(40, share)
    wrong = round(40 * share)
    found = solve_robust(with_fixes(made, off).graph)
    good = solve_robust(with_fixes(made, 0 * off).graph)
    assert made.error_m(found.world_from_cam) < 1.5 * made.error_m(good.world_from_cam)
    assert found.notes[0].startswith(f"{wrong} prior") and found.metrics["priors_excess"] < 1.5
    assert not any("left out of 40" in note for note in good.notes)


def test_what_no_solve_heeds_of_a_fix_contradicts_nothing() -> None:
    """Of x and y alone in space, which every solver ignores, "off by 230 times"; so were heights in the plane."""
    none = np.zeros((40, 3))
    made = with_fixes(drive(dimension=3, world="town", seed=2, wrong=0.3, loops=60), none).graph
    assert made.priors is not None
    flat = replace(made.priors, information=made.priors.information * np.diag([0, 0, 0, 1, 1, 0]))
    found = solve_robust(replace(made, priors=flat))
    assert found.metrics["priors_excess"] == 0 and any(note.startswith("40 priors not used") for note in found.notes)
    assert not any("ignored" in note or "pieces" in note for note in found.notes)
    assert any(note.startswith("40 priors not used") for note in diagnose(replace(made, priors=flat)).notes)
    plain = drive(dimension=2, world="town", seed=2, wrong=0.3, loops=60)
    raised = with_fixes(plain, none + [0, 0, 100.0]).graph
    assert raised.priors is not None
    spatial = replace(raised.priors, information=np.tile(np.diag([0, 0, 0, 1, 1, 1]) / FIX_M**2, (40, 1, 1)))
    assert solve_robust(replace(raised, priors=spatial)).metrics["priors_excess"] < 1.5


def test_headings_that_contradict_the_edges_are_told_in_degrees() -> None:
    """ "0 m off"."""
    made = drive(wrong=0.3, loops=60)
    turned = se3.exp(np.outer(np.arange(40) == 7, [0, 0, 1.0, 0, 0, 0]))
    known = np.tile(np.diag([1, 1, 1, 0, 0, 0]) * 1e4, (40, 1, 1))
    priors = Priors(np.arange(0, 400, 10), made.truth[::10] @ turned, known)
    note = solve_robust(replace(made.graph, priors=priors)).notes[0]
    assert note.startswith("1 prior is left out of 40") and "that of vertex 70 is 5" in note and note.endswith("° off")


def test_fixes_that_err_more_than_they_state_all_count() -> None:
    made = with_fixes(drive(wrong=0.3, loops=60), np.random.default_rng(5).normal(0, 1.5, (40, 3)) * [1, 1, 0])
    found = solve_robust(made.graph)
    assert not any("left out of 40" in note for note in found.notes)


def test_fixes_that_contradict_each_other_are_told_in_the_first_line(tmp_path: Path) -> None:
    """Half of them shifted by 10 m: nothing tells which half, and it said "Solved" alone."""
    off = np.zeros((40, 3))
    off[20:, 0] = 10
    made = with_fixes(drive(wrong=0.3, loops=60), off)
    write_g2o(tmp_path / "a.g2o", made.graph)
    assert solve_file(tmp_path / "a.g2o", SolveOptions(robust=True)).headline.startswith(
        "Solved, but priors are off by"
    )
    alone = with_fixes(drive(wrong=1.0, loops=60), 0 * off)
    write_g2o(tmp_path / "b.g2o", alone.graph)
    told = solve_file(tmp_path / "b.g2o", SolveOptions(robust=True)).headline
    assert told.startswith("Solved by consecutive edges and priors, since nothing confirms the 60 others")


def test_a_path_of_steps_and_fixes_with_a_slip_is_solved() -> None:
    """Steps that fixes contradict were left out, and what was between free to turn: an error in place of poses."""
    made = with_fixes(drive(world="town", seed=2, wrong=0.3, loops=60), np.zeros((40, 3)))
    path = made.graph.select(np.abs(np.diff(made.graph.edges, axis=1)[:, 0]) == 1)
    motions = path.i_from_j.copy()
    motions[200] = motions[200] @ se3.exp(np.array([0, 0, 0.3, 4, 0, 0]))
    slipped = replace(path, i_from_j=motions)
    found = solve_robust(slipped)
    assert (found.weights > 0).all()
    assert made.error_m(found.world_from_cam) < 0.5 * made.error_m(replace(made, graph=slipped).odometry())


@pytest.mark.parametrize("dimension", [2, 3])
def test_a_diagnosis_tells_priors_that_contradict_the_edges(dimension: int) -> None:
    """It said nothing of priors."""
    made = drive(dimension=dimension, world="town", seed=2, wrong=0.3, loops=60)
    spoilt, good = (diagnose(with_fixes(made, far_off(40, share)).graph) for share in (0.2, 0.0))
    assert spoilt.findings[-1].startswith("8 of 40 priors contradict the edges and the others: that of vertex")
    assert any(note.startswith("32 priors are off by") for note in spoilt.notes)
    assert any(note.startswith("40 priors are off by") for note in good.notes)
    assert not any("prior" in finding for finding in good.findings)


def test_priors_that_are_not_used_contradict_nothing_and_are_not_counted() -> None:
    """The first ten of 40, of which three are wrong, lack the height: "of 40 priors"."""
    spoilt = with_fixes(drive(dimension=3, world="town", seed=2, wrong=0.3, loops=60), far_off(40, 0.2)).graph
    assert spoilt.priors is not None
    information = spoilt.priors.information.copy()
    information[:10, 5, 5] = 0.0
    found = diagnose(replace(spoilt, priors=replace(spoilt.priors, information=information)))
    assert found.findings[-1].startswith("5 of 30 priors contradict the edges and the others")
    assert any(note.startswith("25 priors are off by") for note in found.notes)


def test_a_fix_that_states_no_rotation_is_called_no_edge() -> None:
    """ "40 edges have no definite information on rotation"."""
    notes = solve(with_fixes(drive(wrong=0.0, loops=20), far_off(40, 0.0)).graph).notes
    assert not any("edge" in note for note in notes)


def test_a_diagnosis_tells_priors_that_err_more_than_they_state() -> None:
    made = drive(wrong=0.3, loops=60)
    off = np.random.default_rng(1).normal(0, 20 * FIX_M, (40, 3)) * [1, 1, 0]
    found = diagnose(with_fixes(made, off).graph)
    assert found.findings[-1].startswith("40 priors are off by") and "times what they state" in found.findings[-1]
