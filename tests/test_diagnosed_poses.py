"""The poses of a diagnosis: of maximum likelihood where edges err as they state, else by learned errors."""

from dataclasses import replace

import numpy as np

from benchmarks.spoilt_graphs import mistaken_cases
from benchmarks.wrong_loops import position_error, right_alone
from hodge_pipeline import se3
from hodge_pipeline.diagnosis.diagnosis import diagnose
from hodge_pipeline.solvers.explained import is_each_explained, is_each_usual, is_explained
from hodge_pipeline.solvers.maximum_likelihood import solve
from hodge_pipeline.types import ViewGraph
from tests.backbone_graphs import drive


def test_where_edges_err_as_they_state_the_poses_are_the_likeliest() -> None:
    made = drive()
    found = diagnose(made.graph)
    kept = made.graph.select(np.flatnonzero(found.kept))
    best = solve(kept, start=found.world_from_cam, initial="given").world_from_cam
    np.testing.assert_allclose(found.world_from_cam, best, atol=1e-6)


def test_wrong_edges_that_stated_errors_hide_do_not_bend_the_poses() -> None:
    """Errors stated ten times too large: 119 loops over too short a way are kept, 3.4 m for 0.13 by what they state."""
    name = "corridor, 67% shortened, sigmas × 10"
    case = next(case for case in mistaken_cases(1) if case.name == name)
    found = diagnose(case.graph)
    assert (found.kept & ~case.right).sum() > 100
    assert position_error(found.world_from_cam[:, :3, 3], case.places) < 2 * right_alone(case)


def test_errors_that_are_alike_but_not_as_learned_do_not_bend_the_poses() -> None:
    """The learned errors of steps are too small for some of them, 0.17 m for 0.07 by what they state."""
    case = next(case for case in mistaken_cases(1) if case.name == "corridor, 67% inverted, sigmas × 1")
    found = diagnose(case.graph)
    assert position_error(found.world_from_cam[:, :3, 3], case.places) < 1.2 * right_alone(case)


def test_steps_and_loops_are_each_held_to_their_own_errors() -> None:
    made = drive(wrong=0.0, loops=300)
    steps = np.abs(np.diff(made.graph.edges, axis=1)[:, 0]) == 1
    wide = replace(made.graph, information=made.graph.information * np.where(steps, 0.01, 0.04)[:, None, None])
    assert is_each_usual(wide, solve(wide).world_from_cam, steps)
    motions = wide.i_from_j.copy()
    motions[-1] = motions[-1] @ se3.exp(np.array([[0, 0, 0.08, 0, 0, 0]]))[0]
    off = replace(wide, i_from_j=motions)
    assert is_each_explained(off, solve(off).world_from_cam)  # what is stated is far too large
    assert not is_each_usual(off, solve(off).world_from_cam, steps)


def test_one_edge_far_off_is_not_explained_among_many() -> None:
    made = drive(wrong=0.0, loops=300)
    assert is_each_explained(made.graph, solve(made.graph).world_from_cam)
    motions = made.graph.i_from_j.copy()
    motions[-1] = motions[-1] @ se3.exp(np.array([[0, 0, 0.08, 0, 0, 0]]))[0]
    off = replace(made.graph, i_from_j=motions)
    solution = solve(off)
    assert is_explained(off, solution)  # all together hide it
    assert not is_each_explained(off, solution.world_from_cam)


def test_information_of_nothing_but_ones_explains_nothing() -> None:
    made = drive(wrong=0.0)
    graph = ViewGraph.from_edges(made.graph.vertex_ids, made.graph.edges, made.graph.i_from_j)
    assert not is_explained(graph, solve(graph))
