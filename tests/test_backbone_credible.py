"""Covariances that robots fill with constants for what they do not know: the loops tell how steps err."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from backbone_graphs import drive
from hodge_pipeline import se3
from hodge_pipeline.diagnosis.diagnosis import diagnose
from hodge_pipeline.diagnosis.robust import solve_robust
from hodge_pipeline.refine.pose_graph import read_graph
from hodge_pipeline.solvers.backbone.credible import credible_steps
from hodge_pipeline.solvers.backbone.sequence import sequential_edges
from hodge_pipeline.types import Floats, ViewGraph
from test_backbone import NEVER_WORSE

OF_ROBOTS = np.diag([1e-6, 1e-6, 1e-3, 1e3, 1e3, 1e-6])
"""The information of a wheeled base's odometry in many ROS drivers: 1e6 for height, roll and pitch, 1e3 for heading."""


def stating(graph: ViewGraph, information: Floats) -> ViewGraph:
    """The graph whose steps state this (6, 6)."""
    out = graph.information.copy()
    axes = np.array([2, 3, 4]) if graph.dimension == 2 else np.arange(6)
    out[np.ix_(np.flatnonzero(sequential_edges(graph)), axes, axes)] = information[np.ix_(axes, axes)]
    return replace(graph, information=out)


@pytest.mark.parametrize(
    ("dimension", "world", "seed", "wrong"),
    [(2, "ring", 0, 0.0), (3, "town", 2, 0.0), (2, "room", 0, 0.5), (3, "ring", 0, 0.5), (3, "corridor", 1, 0.5)],
)
def test_steps_that_state_nothing_of_some_axes(dimension: int, world: str, seed: int, wrong: float) -> None:
    """All right loops were lost, or poses up to 90 m off where odometry has 0.6; the robust solve was worse yet."""
    made = drive(seed=seed, dimension=dimension, world=world, wrong=wrong, loops=60)
    graph, odometry_m = stating(made.graph, OF_ROBOTS), made.error_m(made.odometry())
    found, as_stated = diagnose(graph), diagnose(made.graph)
    assert not (found.kept & ~made.right).any()
    assert (found.kept & made.right).sum() >= 0.9 * made.right.sum()
    assert "as loops show them" in " ".join(found.notes)
    for poses in (found.world_from_cam, solve_robust(graph).world_from_cam):
        assert made.error_m(poses) < max(1.5 * made.error_m(as_stated.world_from_cam), 0.65 * odometry_m)
        assert made.error_m(poses) <= NEVER_WORSE * odometry_m


def test_what_is_believed_of_steps() -> None:
    graph = drive(dimension=3, wrong=0.0, loops=10).graph
    steps = sequential_edges(graph)
    for stated in (graph, replace(graph, information=np.tile(np.eye(6), (graph.edge_count, 1, 1)))):
        same, as_stated = credible_steps(stated, steps)
        assert same is stated and as_stated
    changed, as_stated = credible_steps(stating(graph, OF_ROBOTS), steps)
    assert not as_stated
    np.testing.assert_array_equal(changed.information[~steps], graph.information[~steps])
    errors = np.sqrt(np.diag(np.linalg.inv(changed.information[steps][0])))
    np.testing.assert_allclose(errors[3:5], np.sqrt(1e-3), rtol=1e-6)
    moved = se3.log(graph.i_from_j[steps])
    np.testing.assert_allclose(errors[5], 0.2 * np.sqrt(np.mean(moved[:, 3:] ** 2)), rtol=1e-6)
    np.testing.assert_allclose(errors[:3], 0.2 * np.sqrt(np.mean(moved[:, :3] ** 2)), rtol=1e-6)
    nothing, as_stated = credible_steps(graph, np.zeros_like(steps))
    assert nothing is graph and as_stated


def test_a_direction_that_few_steps_do_not_measure_is_as_stated() -> None:
    """A robot that slides along a bare corridor for a while says so, and that is believed."""
    graph = drive(dimension=3, wrong=0.0, loops=10).graph
    information = graph.information.copy()
    sliding = np.flatnonzero(sequential_edges(graph))[100:150]
    information[sliding, 3, 3] = 1e-3
    stated = replace(graph, information=information)
    assert credible_steps(stated, sequential_edges(graph))[0] is stated


@pytest.mark.parametrize("name", ["parking-garage", "cubicle"])
def test_information_of_a_radian_or_of_one_axis_that_is_known_far_better_is_believed(data_dir: Path, name: str) -> None:
    graph = read_graph(data_dir / f"pose_graphs/sesync/{name}.g2o").graph
    assert graph is not None and credible_steps(graph, sequential_edges(graph))[1]


@pytest.mark.parametrize("sigma", [1e-5, 1e-3])
def test_a_plane_that_is_stated_in_space_is_judged_as_in_the_plane(sigma: float) -> None:
    """Heights that always agree spoke for every wrong loop: 34 m where odometry has 9."""
    made = drive(world="streets", wrong=0.8, loops=200, count=600)
    information, out_of_plane = made.graph.information.copy(), [0, 1, 5]
    information[:, out_of_plane, out_of_plane] = sigma**-2.0
    found = diagnose(replace(made.graph, information=information, dimension=3))
    np.testing.assert_array_equal(found.kept, made.right)
    assert made.error_m(found.world_from_cam) <= 1.1 * made.error_m(diagnose(made.graph).world_from_cam)


@pytest.mark.parametrize("seed", [0, 1])
def test_axes_that_are_exact_hide_no_right_loop(seed: int) -> None:
    """Underwater, pressure tells the depth and gravity the tilt, far better than sonar tells the rest: 65 and 27 of
    100 right loops were lost.
    """
    made = drive(seed=seed, dimension=3, world="room", wrong=0.5, loops=200)
    graph, steps = made.graph, sequential_edges(made.graph)
    rng = np.random.default_rng(seed)
    spread = np.where(steps[:, None], [1e-5, 1e-5, 0.01, 0.1, 0.1, 1e-5], [1e-5, 1e-5, 0.02, 0.2, 0.2, 1e-5])
    exact = se3.inverse(made.truth[graph.edges[:, 0]]) @ made.truth[graph.edges[:, 1]]
    motions = np.where(made.right[:, None, None], exact, graph.i_from_j)
    motions = motions @ se3.exp(spread * rng.standard_normal(spread.shape))
    graph = replace(graph, i_from_j=motions, information=np.eye(6) / spread[:, None] ** 2)
    found = diagnose(graph)
    assert not (found.kept & ~made.right).any()
    assert (found.kept & made.right).sum() >= 0.98 * made.right.sum()
    assert made.error_m(found.world_from_cam) <= NEVER_WORSE * made.error_m(replace(made, graph=graph).odometry())


@pytest.mark.parametrize(("world", "wrong", "seed"), [("town", 0.5, 0), ("town", 0.9, 1), ("room", 1.0, 1)])
def test_what_gravity_and_pressure_tell_of_wrong_loops_too_confirms_none(world: str, wrong: float, seed: int) -> None:
    """A place taken for another is measured at its own depth and tilt, which the path has so too: such loops bent it to
    20.7, 38.4 and 3.4 m where odometry has 8.6, 3.2 and 1.5.
    """
    made = drive(seed=seed, dimension=3, world=world, wrong=wrong, loops=200, count=600)
    graph, bad, steps = made.graph, ~made.right, sequential_edges(made.graph)
    rng, (here, there) = np.random.default_rng(seed), made.truth[graph.edges.T]
    spread = np.where(steps[:, None], [0.01, 0.1, 0.1], [0.02, 0.2, 0.2])
    noise = spread * rng.standard_normal(spread.shape)
    turned = se3.exp(np.pad(noise[:, :1], ((0, 0), (2, 3)))) @ se3.from_parts(there[:, :3, :3], np.zeros(3))
    turned[:, :3, 3] = there[:, :3, 3] + np.pad(noise[:, 1:], ((0, 0), (0, 1)))
    turned[bad, :2, 3] = here[bad, :2, 3] + rng.normal(0, 1, (bad.sum(), 2))
    information = np.eye(6) / np.pad(spread, ((0, 0), (2, 1)), constant_values=1e-4)[:, None] ** 2
    graph = replace(graph, i_from_j=se3.inverse(here) @ turned, information=information)
    found = diagnose(graph)
    assert (found.kept & bad).sum() <= 2
    assert made.error_m(found.world_from_cam) <= NEVER_WORSE * made.error_m(replace(made, graph=graph).odometry())
    assert wrong > 0.9 or (found.kept & made.right).sum() > sequential_edges(graph).sum()


def test_an_axis_that_is_told_a_million_times_better_hides_no_other() -> None:
    """A robot on a floor knows its roll to a microradian and its heading to a hundredth."""
    spread = np.array([[1e-6, 1e-6, 1e-2, 0.1, 0.1, 1e-6]])
    information = np.eye(6) / np.tile(spread, (4, 1))[:, None] ** 2
    np.testing.assert_allclose(np.einsum("eii->ei", se3.covariances(information)), spread[[0] * 4] ** 2, rtol=1e-9)
