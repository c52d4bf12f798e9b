"""The diagnosis on real pairwise estimates, of which a known part is wrong."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.edge_scores import PairTruth, area_under_roc, pose_recall, precision_and_recall, read_estimates
from hodge_pipeline import se3
from hodge_pipeline.diagnosis.diagnosis import diagnose
from hodge_pipeline.diagnosis.result import UNTESTABLE
from hodge_pipeline.diagnosis.robust import RobustSolver
from hodge_pipeline.refine.pose_graph import read_graph
from hodge_pipeline.types import Bools, ViewGraph


def estimates(data_dir: Path, scene: str, method: str) -> tuple[ViewGraph, PairTruth, Bools]:
    """A graph of real estimates, the truth, and which of its edges are right."""
    return read_estimates(data_dir / "fragments/pair_estimates" / f"{scene}-evaluation" / f"{method}.log")


@pytest.mark.parametrize(
    ("scene", "method", "least_precision", "least_recall", "least_auc", "least_pose_recall"),
    [
        ("7-scenes-redkitchen", "3dmatch", 0.98, 0.9, 0.98, 0.98),
        ("iclnuim-office1", "fpfh", 0.9, 0.9, 0.97, 0.8),
        ("iclnuim-livingroom1", "fpfh", 0.88, 0.9, 0.96, 0.75),
    ],
)
def test_wrong_edges_of_real_scenes_are_told_from_right_ones(
    data_dir: Path, scene: str, method: str, least_precision: float, least_recall: float, least_auc: float,
    least_pose_recall: float,
) -> None:  # fmt: skip
    graph, truth, right = estimates(data_dir, scene, method)
    found = diagnose(graph)
    precision, recall = precision_and_recall(found.kept, right)
    assert precision >= least_precision and recall >= least_recall
    assert area_under_roc(found.probability, right) >= least_auc
    assert pose_recall(truth, found.world_from_cam, found.piece) >= least_pose_recall
    assert np.isnan(found.probability[found.verdict == UNTESTABLE]).all()


def test_few_right_edges_of_a_real_scene_are_blamed_where_all_are_right(data_dir: Path) -> None:
    graph, truth, right = estimates(data_dir, "7-scenes-redkitchen", "3dmatch")
    found = diagnose(graph.select(right))
    assert found.kept.mean() > 0.9
    assert pose_recall(truth, found.world_from_cam, found.piece) == 1.0


@pytest.mark.parametrize(
    ("name", "most_blamed"),
    [("slambook_2d/INTEL.g2o", 0.0), ("sesync/kitti_00.g2o", 0.005)],
)
def test_hardly_an_edge_of_a_sound_pose_graph_is_blamed(data_dir: Path, name: str, most_blamed: float) -> None:
    """At the optimum nearly all edges are far within what their information states."""
    graph = read_graph(data_dir / "pose_graphs" / name).graph
    assert graph is not None
    found = diagnose(graph)
    assert (~found.kept).mean() <= most_blamed
    assert (found.verdict == UNTESTABLE).mean() < 0.03


def test_wrong_loops_do_not_put_the_blame_on_what_drifted(data_dir: Path) -> None:
    """The first vertices of a path are long enough to drift by more than what is wrong."""
    whole = read_graph(data_dir / "pose_graphs/gtsam/w20000.txt").graph
    assert whole is not None
    vertices = 4000
    rows = (whole.edges < vertices).all(axis=1)
    graph = ViewGraph.from_edges(
        whole.vertex_ids[:vertices], whole.edges[rows], whole.i_from_j[rows], whole.information[rows],
        dimension=whole.dimension,
    )  # fmt: skip
    loops = np.flatnonzero(np.abs(graph.edges[:, 1] - graph.edges[:, 0]) > 1)
    rng = np.random.default_rng(1)
    bad = rng.choice(loops, len(loops) // 10, replace=False)
    off = np.zeros((len(bad), 6))
    off[:, 2:5] = rng.normal(size=(len(bad), 3)) * [1, 5, 5]
    measured = graph.i_from_j.copy()
    measured[bad] = measured[bad] @ se3.exp(off)
    found = diagnose(replace(graph, i_from_j=measured))
    right = np.ones(graph.edge_count, bool)
    right[bad] = False
    assert (~found.kept[right]).mean() <= 0.015
    assert found.kept[~right].mean() <= 0.1  # some are changed by little, some in no cycle


def test_a_step_is_not_broken_for_what_larger_errors_of_all_steps_explain(data_dir: Path) -> None:
    """RobotCar's step back by 16 m: with a bridge in its place and errors learned anew loops were likelier, and as much
    so with these errors alone."""
    graph = read_graph(data_dir / "pose_graphs/slam_loops/robotcar/few/graph.g2o").graph
    assert graph is not None
    found = diagnose(graph)
    steps = np.abs(np.diff(graph.edges, axis=1)[:, 0]) == 1
    assert steps.sum() == 1769 and found.kept[steps].all()


def test_the_robust_solver_finds_the_poses_of_a_real_scene(data_dir: Path) -> None:
    graph, truth, right = estimates(data_dir, "7-scenes-redkitchen", "3dmatch")
    solution = RobustSolver().solve(graph, np.tile(np.eye(4), (graph.vertex_count, 1, 1)))
    assert pose_recall(truth, solution.world_from_cam, solution.component) >= 0.999
    assert (solution.weights[~right] > 0).mean() < 0.1 < 0.75 < (solution.weights[right] > 0).mean()
