"""Graphs of more loops than steps, none of which agrees with the odometry: wrong loops, or a wrong odometry."""

from __future__ import annotations

from dataclasses import replace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from backbone_graphs import Drive, at_one_place, broken, drive, round_trip
from benchmarks.spoilt_graphs import lattice_cases
from hodge_pipeline import se3
from hodge_pipeline.diagnosis.diagnosis import diagnose
from hodge_pipeline.solvers.backbone import bridged, inference
from hodge_pipeline.solvers.backbone.evidence import BY_CHANCE
from hodge_pipeline.solvers.backbone.trust import find_backbone
from hodge_pipeline.types import Floats, ViewGraph
from test_backbone import NEVER_WORSE


@pytest.mark.parametrize(("seed", "stated"), [(5010, True), (5019, False)])
def test_groups_of_wrong_loops_as_many_as_steps_are_no_lattice(seed: int, stated: bool) -> None:
    """Each holds together by itself, and a step left out for each lets all of them stand: 20 m."""
    made = drive(seed=seed, count=120, dimension=2 + seed % 2, world="town", loops=150, wrong=1.0, in_groups=True)
    graph = made.graph
    if not stated:
        graph = replace(graph, information=((graph.information != 0) & np.eye(6, dtype=bool)).astype(float))
    found = diagnose(graph)
    assert made.error_m(found.world_from_cam) <= NEVER_WORSE * made.error_m(made.odometry())
    assert not np.isin(found.verdict[made.right], ("wrong", "suspect")).any()


@pytest.mark.parametrize(("seed", "dimension"), [(1, 2), (2, 3)])
def test_cycles_that_close_by_chance_do_not_refute_an_odometry(seed: int, dimension: int) -> None:
    """Where a metre is stated for every edge cycles of random loops close: all were used, 13 to 15 m off for .2."""
    made = drive(seed=seed, count=100, dimension=dimension, world="town", loops=150, wrong=1.0)
    stated = 0.9 * ((made.graph.information != 0) & np.eye(6, dtype=bool))
    found = diagnose(replace(made.graph, information=stated))
    assert made.error_m(found.world_from_cam) <= NEVER_WORSE * made.error_m(made.odometry())


@pytest.mark.parametrize("seed", [1, 5])
def test_wrong_loops_over_few_steps_are_no_lattice(seed: int) -> None:
    """More of them than steps: that a place is taken for the next but one makes pairs of them agree: 22 m."""
    made = at_one_place(drive(seed=seed, count=150, world="town", loops=20, wrong=0.0), 300, group=5, spans=20)
    found = diagnose(made.graph)
    assert made.error_m(found.world_from_cam) <= NEVER_WORSE * made.error_m(made.odometry())


@pytest.mark.parametrize(("seed", "dimension"), [(0, 2), (0, 3)])
def test_loops_half_of_which_are_displaced_alike_do_not_refute_a_right_odometry(seed: int, dimension: int) -> None:
    """As where one corridor is taken for the next: steps were left out so that both halves could stand, 4 and 3 m."""
    made = drive(seed=seed, dimension=dimension, count=200, world="town", loops=200, wrong=0.0)
    rng, motion, right = np.random.default_rng(seed), made.graph.i_from_j.copy(), made.right.copy()
    loops = np.flatnonzero(np.diff(made.graph.edges, axis=1)[:, 0] != 1)
    wrong = rng.choice(loops, len(loops) // 2, replace=False)
    away = rng.normal(size=2)
    displaced = se3.from_parts(np.eye(3), np.append(5 * away / np.linalg.norm(away), 0.0))
    here = made.truth[made.graph.edges[wrong, 0]]
    motion[wrong] = se3.inverse(here) @ displaced @ here @ motion[wrong]
    right[wrong] = False
    made = replace(made, graph=replace(made.graph, i_from_j=motion), right=right)
    found = diagnose(made.graph)
    assert made.error_m(found.world_from_cam) < 0.5 * made.error_m(made.odometry())


def test_groups_of_wrong_loops_at_one_place_are_as_many_testimonies() -> None:
    """As they contradict each other, they are no larger group than the right one: it was refused, 1.9 m."""
    made = round_trip(0, 6, dimension=2, wrong=1000, group=5)
    assert made.error_m(diagnose(made.graph).world_from_cam) < 0.6


def test_two_groups_that_agree_by_chance_agree_once() -> None:
    """Of so many groups some do; each counted for the other, they outweighed the odometry: 18 m for 3."""
    made = round_trip(2, 6, dimension=2, wrong=1000, group=5)
    assert made.error_m(diagnose(made.graph).world_from_cam) <= NEVER_WORSE * made.error_m(made.odometry())


def test_the_one_turn_to_the_right_is_no_broken_step() -> None:
    """In a town of turns to the left: wrong loops in long groups agreed that it was, 32 m from the truth."""
    made = drive(
        seed=935122, count=300, world="town", loops=360, wrong=1.0, in_groups=True, group=50, misstated=(0.3, 2.0)
    )
    found = diagnose(made.graph)
    assert made.error_m(found.world_from_cam) <= NEVER_WORSE * made.error_m(made.odometry())


def test_a_lattice_whose_odometry_is_wrong_at_many_steps_needs_none() -> None:
    """Loops that begin and end beside these steps contradict them, also where no single one passes over few."""
    made = drive(seed=8, count=300, dimension=3, loops=450, wrong=0.0)
    graph = made.graph
    for step in range(5, 295, 12):
        graph = broken(replace(made, graph=graph), step, seed=step)
    found = diagnose(graph)
    assert made.error_m(found.world_from_cam) < 0.2
    wrong = np.flatnonzero((np.diff(graph.edges, axis=1)[:, 0] == 1) & (graph.edges[:, 0] % 12 == 5))
    assert not found.kept[wrong].any()


def test_a_fifth_of_the_edges_of_a_lattice_are_wrong() -> None:
    """Rows walked to and fro, each joined to the next: growing alone ended 5 m off."""
    rng, k = np.random.default_rng([0, 200, 20]), np.arange(100)
    row, along = k // 10, k % 10
    back = row % 2 == 1
    place = np.stack([np.where(back, 9 - along, along), row, 0 * k], axis=1).astype(float)
    truth = se3.from_parts(se3.so3_exp(np.outer(np.where(back, np.pi, 0.0), [0.0, 0, 1])), place)
    i, j = np.triu_indices(100, 1)
    edges = np.stack([i, j], axis=1)[np.linalg.norm(place[i] - place[j], axis=1) < 1.05]
    exact = se3.inverse(truth[edges[:, 0]]) @ truth[edges[:, 1]]
    motions = exact @ se3.exp(rng.normal(size=(len(edges), 6)) * np.repeat([0.01, 0.04], 3))
    wrong = rng.random(len(edges)) < 0.2
    motions[wrong] = motions[wrong] @ se3.exp(rng.normal(0, 1, (int(wrong.sum()), 6)))
    made = Drive(ViewGraph.from_edges(k, edges, motions), truth, ~wrong)
    found = diagnose(made.graph)
    assert made.error_m(found.world_from_cam) < 1.0
    assert (found.kept & wrong).sum() <= 5


def test_breaks_are_not_sought_where_cycles_explain_all_and_many_steps_are_wrong(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """It took seven times as long as all else, for a backbone that gave way to the cycles."""
    case = next(case for case in lattice_cases(1) if case.name == "cylinder of 200, 5% wrong")
    sought = Mock()
    monkeypatch.setattr(bridged, "_better", sought)
    np.testing.assert_array_equal(diagnose(case.graph).kept, case.right)
    sought.assert_not_called()


def test_poses_are_not_followed_to_where_loops_are_less_likely(monkeypatch: pytest.MonkeyPatch) -> None:
    """In Manhattan's graph with 500 wrong loops each further round took longer and led farther away."""
    rounds = list[list[float]]()
    agreed, mixture = inference._Trial.agreed, inference.mixture

    def told(factor: Floats) -> tuple[Floats, float]:
        found = mixture(factor)
        rounds[-1].append(found[1])
        return found

    def followed(trial: inference._Trial, *inputs: Any) -> Any:
        rounds.append([])
        with monkeypatch.context() as patch:
            patch.setattr(inference, "mixture", told)
            return agreed(trial, *inputs)

    monkeypatch.setattr(inference._Trial, "agreed", followed)
    diagnose(drive(seed=0, world="corridor", count=150, loops=100, wrong=0.8, in_groups=True).graph)
    best = [np.maximum.accumulate(row) for row in rounds]
    falls = [(np.array(row) < top - BY_CHANCE).tolist() for row, top in zip(rounds, best, strict=True)]
    assert any(row[-1] for row in falls) and not any(fell for row in falls for fell in row[:-1])


def test_loops_are_judged_once_where_steps_err_as_usual(monkeypatch: pytest.MonkeyPatch) -> None:
    """Learned errors of less than twice the stated ones say nothing: judging by stated ones too takes as long again."""
    judged = Mock(side_effect=inference.LoopJudge.infer)
    monkeypatch.setattr(inference.LoopJudge, "infer", lambda *given: judged(*given))
    backbone = find_backbone(drive(seed=3, wrong=0.3, misstated=(0.7, 1.0)).graph)
    assert backbone is not None and 1.0 < backbone.found.scales.of_steps < 2.0
    assert judged.call_count == 1
