"""What speaks for a backbone where cycles leave some of its steps out."""

from __future__ import annotations

import numpy as np
import pytest

from backbone_graphs import drive
from hodge_pipeline.solvers.backbone.lattice import lattice_backbone, left_out_steps
from hodge_pipeline.solvers.backbone.trust import Backbone, find_backbone
from hodge_pipeline.types import Bools, Ints, ViewGraph

STEPS = 119


@pytest.fixture(scope="module")
def graph() -> ViewGraph:
    """A ring with 20 right loops, 20 wrong ones, and short ones over some of the steps."""
    return drive(count=STEPS + 1, loops=40, wrong=0.5, short=20).graph


@pytest.fixture(scope="module")
def backbone(graph: ViewGraph) -> Backbone:
    found = find_backbone(graph, in_lattice=True)
    assert found is not None and found.found.confirmed
    return found


def without(graph: ViewGraph, steps: Ints) -> Bools:
    return ~np.isin(np.arange(graph.edge_count), steps)


@pytest.fixture(scope="module")
def by_contradiction(graph: ViewGraph) -> tuple[Ints, Ints]:
    """Every third step: those that nothing near contradicts where it is left out, and the others."""
    steps = np.arange(1, STEPS, 3)
    free = np.array([left_out_steps(graph, without(graph, steps[k : k + 1]))[1] for k in range(len(steps))])
    return steps[free == 1], steps[free == 0]


@pytest.mark.parametrize(("free", "contradicted", "stands"), [(2, 0, True), (1, 4, False)])
def test_steps_left_out_that_nothing_near_contradicts_speak_for_a_confirmed_backbone(
    graph: ViewGraph,
    backbone: Backbone,
    by_contradiction: tuple[Ints, Ints],
    free: int,
    contradicted: int,
    stands: bool,
) -> None:
    kept = without(graph, np.concatenate([by_contradiction[0][:free], by_contradiction[1][::4][:contradicted]]))
    assert left_out_steps(graph, kept) == (free + contradicted, free)
    assert 4 < backbone.places(kept & ~backbone.used) < 8
    assert (lattice_backbone(graph, kept) is not None) == stands


def test_only_loops_over_steps_that_are_left_out_speak_against_the_backbone(
    graph: ViewGraph, backbone: Backbone
) -> None:
    wrong, steps = np.flatnonzero(~backbone.used), np.arange(1, STEPS)
    low, high = np.sort(graph.edges[wrong], axis=1).T
    against = np.array([backbone.places_against(without(graph, step)) for step in steps])
    over = ((low <= steps[:, None]) & (steps[:, None] < high)).sum(axis=1)
    assert (against <= over).all() and against.max() > 2 and against.min() == 0
