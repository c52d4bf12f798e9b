"""Odometry whose steps are all too long or too short by one factor against the loops: it is named."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from backbone_graphs import drive
from benchmarks.alike_worlds import alike_cases
from hodge_pipeline.diagnosis.diagnosis import diagnose
from hodge_pipeline.diagnosis.robust import solve_robust
from hodge_pipeline.report.diagnosis_page import sentence
from hodge_pipeline.solvers.backbone.trust import find_backbone
from hodge_pipeline.types import ViewGraph


def of_length(graph: ViewGraph, times: float, first: int = 0, *, in_two: bool = False) -> ViewGraph:
    """The graph with steps from vertex `first` on so many times as long; `in_two`: without the step to it."""
    low, motion = graph.edges.min(axis=1), graph.i_from_j.copy()
    steps = np.abs(np.diff(graph.edges, axis=1)[:, 0]) == 1
    motion[steps & (low >= first), :3, 3] *= times
    return replace(graph, i_from_j=motion).select(~(steps & (low == first - 1) & in_two))


def told(graph: ViewGraph) -> str:
    backbone = find_backbone(graph)
    assert backbone is not None and backbone.found.confirmed
    return "; ".join(each for each in backbone.findings if "times too" in each)


def factor_of(named: str) -> float:
    words = named.split(" are ")[1].split()
    return float(words[0]) if words[3] == "long" else 1 / float(words[0])


@pytest.mark.parametrize(("dimension", "world"), [(2, "room"), (3, "ring")])
def test_an_odometry_of_a_wrong_scale_is_named(dimension: int, world: str) -> None:
    """ "Solved", 1.3 times as large as the world."""
    graph = of_length(drive(dimension=dimension, world=world).graph, 1.3)
    found = diagnose(graph)
    named = next(each for each in found.notes if "times too long" in each)
    assert factor_of(named) == pytest.approx(1.3, rel=0.03) and named in sentence(graph, found)
    assert named in solve_robust(graph).notes


@pytest.mark.parametrize("times", [1.3, 0.8])
def test_a_session_of_another_scale_is_named_by_its_vertices(times: float) -> None:
    named = told(of_length(drive(dimension=3, world="room").graph, times, 200, in_two=True))
    assert named.startswith("consecutive edges of vertices 200 to 399 are ")
    assert factor_of(named) == pytest.approx(times, rel=0.03)


@pytest.mark.parametrize("in_two", [False, True])
@pytest.mark.parametrize(("dimension", "world"), [(2, "room"), (2, "corridor"), (3, "ring")])
def test_a_right_scale_is_not_named(dimension: int, world: str, in_two: bool) -> None:
    assert not told(of_length(drive(dimension=dimension, world=world).graph, 1.0, 200, in_two=in_two))


def test_loops_that_agree_only_one_of_each_place_name_no_scale() -> None:
    """Storeys that look alike: "1.40 times too long", by half of the used loops, which are mistaken."""
    case = next(each for each in alike_cases(1) if each.name == "storeys, 30% wrong, 0.02 m a step, stated × 3.0")
    assert not told(case.graph)


def test_loops_of_almost_one_place_name_no_scale(data_dir: Path) -> None:
    """Those of Bicocca make a shorter path likelier, however short: "2.29 times too long"."""
    from hodge_pipeline.refine.pose_graph import read_graph

    graph = read_graph(data_dir / "pose_graphs/slam_loops/bicocca/B25b_0.250.g2o").graph
    assert graph is not None and not told(graph)
