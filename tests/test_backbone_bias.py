"""Odometry whose steps all turn too far: the bias is estimated from loops and taken out."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from backbone_graphs import drive, with_weak_steps
from benchmarks.biased_worlds import biased_cases
from benchmarks.spoilt_graphs import Case
from benchmarks.wrong_loops import odometry, position_error, right_alone
from hodge_pipeline import se3
from hodge_pipeline.diagnosis.diagnosis import diagnose
from hodge_pipeline.diagnosis.robust import solve_robust
from hodge_pipeline.report.diagnosis_page import sentence
from hodge_pipeline.solvers.backbone.trust import Backbone, find_backbone
from hodge_pipeline.types import ViewGraph

TURNED_RAD = {
    "walk of 900, 0.012 rad a step too much, 40% random wrong, stated × 1.0": 0.012,  # nothing was confirmed
    "walk of 900, 0.006 rad a step too much, 60% streets wrong, stated × 1.0": 0.006,  # two steps were called wrong
    "walk of 900, 0.006 rad a step too much, 80% random wrong, stated × 1.0": 0.006,
    "flight of 900, 0.012 rad a step too much, 0%  wrong, stated × 1.0": 0.012,
}


def case_of(name: str) -> Case:
    return next(case for case in biased_cases(1) if case.name == name)


def backbone_of(graph: ViewGraph) -> Backbone:
    found = find_backbone(graph)
    assert found is not None
    return found


@pytest.mark.parametrize("name", TURNED_RAD)
def test_the_loops_of_a_biased_odometry_are_told_apart(name: str) -> None:
    case = case_of(name)
    found, backbone = diagnose(case.graph), backbone_of(case.graph)
    np.testing.assert_array_equal(found.kept, case.right)
    error, bare = (
        position_error(poses[:, :3, 3], case.places) for poses in (found.world_from_cam, odometry(case.graph))
    )
    assert error < min(1.1 * right_alone(case), 0.05 * bare)
    assert np.linalg.norm(backbone.chain.bias) == pytest.approx(TURNED_RAD[name], rel=0.15)
    turn_deg = np.degrees(np.linalg.norm(backbone.chain.bias))
    told = f"consecutive edges turn {turn_deg:.2g}° too far each, which is taken out"
    assert told in found.notes and sentence(case.graph, found).endswith(f"; {told}.")


@pytest.mark.parametrize("reverse", [False, True])
def test_a_robust_solve_takes_the_bias_out_of_every_edge_over_steps(reverse: bool) -> None:
    """Edges over three steps have the bias of three."""
    case = case_of("walk of 900, 0.012 rad a step too much, 40% random wrong, stated × 1.0")
    steps, information = case.graph.i_from_j[:899], case.graph.information
    over = np.stack([np.arange(0, 897), np.arange(3, 900)], axis=1)
    noise = np.random.default_rng(0).normal(size=(897, 6)) * [0, 0, 0.003, 0.03, 0.03, 0]
    more = steps[:-2] @ steps[1:-1] @ steps[2:] @ se3.exp(noise)
    edges, motions = np.concatenate([case.graph.edges, over]), np.concatenate([case.graph.i_from_j, more])
    information = np.concatenate([information, information[:897]])
    if reverse:
        edges, motions = edges[:, ::-1], se3.inverse(motions)
        information = se3.pull_back(motions, information)
    graph = ViewGraph.from_edges(case.graph.vertex_ids, edges, motions, information=information)
    assert backbone_of(graph).merged.sum() > 890
    solved = solve_robust(graph)
    assert position_error(solved.world_from_cam[:, :3, 3], case.places) < 1.3 * right_alone(case)


def test_a_robust_solve_has_no_bias_where_stated_errors_would_explain_it() -> None:
    """The solve of the edges as they are agreed with χ²: 7.2 m off, "taken out" all the same."""
    case = case_of("walk of 900, 0.003 rad a step too much, 0%  wrong, stated × 1.0")
    assert backbone_of(case.graph).chain.bias.any()
    assert position_error(solve_robust(case.graph).world_from_cam[:, :3, 3], case.places) < 0.5


@pytest.mark.parametrize("lost", [(450,), (300, 600)])
def test_paths_that_loops_join_have_one_bias(lost: tuple[int, ...]) -> None:
    """Where tracking was lost; the bridges between paths led as biased steps do: 59 and 85 m off."""
    case = case_of("walk of 900, 0.012 rad a step too much, 40% random wrong, stated × 1.0")
    kept = np.setdiff1d(np.arange(case.graph.edge_count), lost)
    backbone = backbone_of(case.graph.select(kept))
    np.testing.assert_array_equal(backbone.used, case.right[kept])
    assert backbone.chain.joins.sum() == len(lost)
    assert np.linalg.norm(backbone.chain.bias) == pytest.approx(0.012, rel=0.1)
    assert position_error(backbone.world_from_cam[:, :3, 3], case.places) < 0.5


@pytest.mark.parametrize("world", ["ring", "town", "corridor"])
@pytest.mark.parametrize("dimension", [2, 3])
def test_drift_of_independent_errors_is_no_bias(world: str, dimension: int) -> None:
    for seed in range(4):
        backbone = backbone_of(drive(seed=seed, world=world, dimension=dimension).graph)
        assert not backbone.chain.bias.any()


def test_a_broken_step_under_all_loops_is_no_bias() -> None:
    made = drive(loops=60, wrong=0.0)
    over = np.flatnonzero((made.graph.edges.min(axis=1) < 200) & (made.graph.edges.max(axis=1) >= 200))
    steps = np.flatnonzero(np.abs(np.diff(made.graph.edges, axis=1)[:, 0]) == 1)
    graph = made.graph.select(np.union1d(steps, over))
    broken = int(np.flatnonzero(graph.edges.min(axis=1) == 199)[0])
    motion = graph.i_from_j.copy()
    motion[broken] = motion[broken] @ se3.exp(np.array([[0, 0, 0.5, 0, 0, 0]]))[0]
    backbone = backbone_of(replace(graph, i_from_j=motion))
    assert not backbone.chain.bias.any()
    assert not backbone.used[broken]


def test_the_drives_of_kitti_turn_by_as_much_too_far(data_dir: Path) -> None:
    """Two drives of one car: 7.4e-5 radians a step in both."""
    from hodge_pipeline.refine.pose_graph import read_graph
    from hodge_pipeline.solvers.backbone.bias import without_bias
    from hodge_pipeline.solvers.backbone.chain import make_chain
    from hodge_pipeline.solvers.backbone.evidence import OutlierModel
    from hodge_pipeline.solvers.backbone.scales import learned_scales
    from hodge_pipeline.solvers.backbone.sequence import sequential_edges

    for name in ("kitti_00", "kitti_05"):
        graph = read_graph(data_dir / f"pose_graphs/sesync/{name}.g2o").graph
        assert graph is not None
        graph = replace(graph, dimension=2)
        chain = make_chain(graph, sequential_edges(graph))
        unbiased = without_bias(chain, next(learned_scales(chain, OutlierModel.of(chain)))[0])
        assert unbiased is not None
        assert unbiased.bias == pytest.approx([7.4e-5], rel=0.02)


def test_no_bias_is_taken_out_whose_breaks_make_loops_less_likely() -> None:
    """Three laps by an odometry that errs by .03 rad a step seemed to turn too far, with two broken steps: 49 m."""
    made = with_weak_steps(drive(seed=2, count=600), 0.03, 2)
    found = diagnose(made.graph)
    np.testing.assert_array_equal(found.kept, made.right)
    assert made.error_m(found.world_from_cam) < 0.05 * made.error_m(made.odometry())
