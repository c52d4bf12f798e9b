"""Loops that join any two places fold a sequence upon itself, which one that stands still is not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from backbone_graphs import at_one_place, drive
from hodge_pipeline import se3
from hodge_pipeline.diagnosis.diagnosis import diagnose
from hodge_pipeline.diagnosis.options import DiagnosisOptions
from hodge_pipeline.diagnosis.robust import solve_robust
from hodge_pipeline.types import ViewGraph


@pytest.fixture(scope="module")
def folded() -> ViewGraph:
    """Seventy steps, each off by a few degrees, 30 right loops and 140 that take two places for one."""
    graph = at_one_place(drive(seed=1, count=70, loops=30, wrong=0, dimension=3), 140, group=5, seed=1).graph
    size = np.repeat([0.06, 0.1], 3) * (np.arange(graph.edge_count) < 69)[:, None]
    off = se3.exp(np.random.default_rng(1).normal(size=(graph.edge_count, 6)) * size)
    return replace(graph, i_from_j=graph.i_from_j @ off, information=np.tile(np.eye(6), (graph.edge_count, 1, 1)))


def test_a_folded_sequence_keeps_its_odometry(folded: ViewGraph) -> None:
    kept = diagnose(folded).kept
    assert kept[:69].all() and not kept[69:].any()


def test_a_folded_sequence_is_not_confirmed(folded: ViewGraph) -> None:
    solution = solve_robust(folded, diagnosis=DiagnosisOptions(trust="none"))
    assert solution.confirmed is False
    assert solution.notes[0].endswith("the others fold the sequence upon itself")


@pytest.mark.parametrize("error", [0.0, 0.003])
def test_right_edges_of_a_sequence_that_mostly_stands_still_are_confirmed(error: float) -> None:
    """Its errors are all that its still steps measure."""
    rng, count = np.random.default_rng(1), 25
    steps = np.array([0, 0, 0.1, 0.3, 0, 0]) * (np.arange(count)[:, None] % 3 == 0)
    truth = se3.exp(np.zeros((count, 6)))
    for row in range(1, count):
        truth[row] = truth[row - 1] @ se3.exp(steps[row])
    pairs = np.argwhere(np.triu(np.ones((count, count)), 1))
    noise = se3.exp(error * rng.normal(size=(len(pairs), 6)))
    motion = se3.inverse(truth[pairs[:, 0]]) @ truth[pairs[:, 1]] @ noise
    graph = ViewGraph.from_edges(np.arange(count), pairs, motion, np.tile(np.eye(6), (len(pairs), 1, 1)))
    solution = solve_robust(graph)
    assert solution.confirmed and solution.kept.all()
