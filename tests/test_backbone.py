"""A right odometry and loops of which many are wrong."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from backbone_graphs import Drive, drive, round_trip
from hodge_pipeline import se3
from hodge_pipeline.diagnosis.diagnosis import diagnose
from hodge_pipeline.diagnosis.options import WRONG_BELOW, DiagnosisOptions
from hodge_pipeline.diagnosis.robust import RobustSolver, solve_robust
from hodge_pipeline.refine.pose_graph import read_graph
from hodge_pipeline.solvers.backbone import fit
from hodge_pipeline.solvers.backbone.chain import make_chain
from hodge_pipeline.solvers.backbone.fit import Fit, Reduced, optimised
from hodge_pipeline.solvers.backbone.lattice import lattice_backbone
from hodge_pipeline.solvers.backbone.linear import cholesky, linearise
from hodge_pipeline.solvers.backbone.sequence import linear_forest, sequential_edges
from hodge_pipeline.solvers.backbone.sparse import NormalEquations
from hodge_pipeline.solvers.backbone.trust import find_backbone, of_every_loop
from hodge_pipeline.solvers.maximum_likelihood import solve
from hodge_pipeline.types import ViewGraph

NEVER_WORSE = 1.02


def chain_of(graph):
    return make_chain(graph, linear_forest(graph.edges, graph.vertex_count, sequential_edges(graph)))


def test_selected_inversion_is_the_dense_inverse() -> None:
    rng = np.random.default_rng(0)
    count = 60
    edges = np.array([(k, k + 1) for k in range(count - 1)] + [(k, (7 * k + 13) % count) for k in range(0, count, 3)])
    edges = edges[edges[:, 0] != edges[:, 1]]
    sides = rng.normal(size=(len(edges), 3, 3))
    precision = sides @ np.swapaxes(sides, 1, 2) + np.eye(3)
    carry = np.eye(3) + 0.3 * np.tril(rng.normal(size=(len(edges), 3, 3)), -1)
    whole = np.zeros((count, 3, count, 3))
    for (i, j), weight, moved in zip(edges, precision, carry, strict=True):
        whole[j, :, j] += weight
        whole[i, :, i] += moved.T @ weight @ moved
        whole[i, :, j] -= moved.T @ weight
        whole[j, :, i] -= weight @ moved
    network = NormalEquations.of(edges, count)
    free = np.flatnonzero(network.place < network.plan.size)
    inverse = np.zeros_like(whole)
    rows = np.ix_(free, range(3), free, range(3))
    inverse[rows] = np.linalg.inv(whole[rows].reshape(3 * len(free), -1)).reshape(len(free), 3, len(free), 3)
    expected = [
        inverse[j, :, j] + moved @ inverse[i, :, i] @ moved.T - moved @ inverse[i, :, j] - inverse[j, :, i] @ moved.T
        for (i, j), moved in zip(edges, carry, strict=True)
    ]
    factored = network.factor(precision, carry)
    np.testing.assert_allclose(factored.across(), expected, atol=1e-11)
    force = rng.normal(size=(count, 3, 2))
    np.testing.assert_allclose(factored.solve(force), np.einsum("iajb,jbc->iac", inverse, force), atol=1e-10)


@pytest.mark.parametrize("dimension", [2, 3])
def test_the_reduced_chain_ends_at_the_minimum_over_all_poses(monkeypatch: pytest.MonkeyPatch, dimension: int) -> None:
    monkeypatch.setattr(fit, "LEAST_WON", 1e-12)
    graph = drive(dimension=dimension, wrong=0.0, loops=30).graph
    chain = chain_of(graph)
    bare = Fit(Reduced.of(chain, np.arange(len(chain.loop_edge))), linearise(chain, chain.poses))
    found = optimised(bare, 30)
    assert found.cost < bare.cost / 10
    exact = solve(graph)
    again = solve(graph, start=found.linear.poses[np.argsort(chain.order)], initial="given")
    assert again.metrics["objective_at_start"] == pytest.approx(exact.metrics["chi2"], rel=1e-3)


def test_an_odometry_that_turns_wrongly_by_six_degrees_a_step_is_solved(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("backbone_graphs.STEP", (0.1, 0.1))
    monkeypatch.setattr("backbone_graphs.LOOP", (0.1, 0.1))
    made = drive(seed=2, count=800, loops=390, wrong=0.0, world="room")
    found = find_backbone(made.graph)
    assert found is not None
    assert found.used.all()
    assert made.error_m(found.world_from_cam) < 0.3


@pytest.mark.parametrize("exact", [1.0, 1e-3])
def test_left_out_residuals_are_those_of_a_solve_without_the_loop(exact: float) -> None:
    chain = chain_of(drive(wrong=0.0, loops=12).graph)
    chain = replace(chain, covariance=exact * chain.covariance)
    found = optimised(Fit(Reduced.of(chain, np.arange(12)), linearise(chain, chain.poses)), 30)
    without = found.left_out(found.reduced.of_loops)[0]
    for row in (0, 5, 11):
        others = Reduced.of(chain, np.delete(np.arange(12), row))
        actual = optimised(Fit(others, found.linear), 30).linear.loops[0][row]
        np.testing.assert_allclose(without[row], actual, atol=0.03 * np.abs(actual).max() + 2e-3)


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize(("wrong", "in_groups"), [(0.0, False), (0.5, False), (0.9, False), (0.6, True)])
def test_right_loops_are_used_and_wrong_ones_are_not(dimension: int, wrong: float, in_groups: bool) -> None:
    made = drive(dimension=dimension, wrong=wrong, in_groups=in_groups)
    found = diagnose(made.graph)
    assert not (found.kept & ~made.right).any()
    assert (found.kept & made.right).sum() >= made.right.sum() - 2
    assert (found.verdict[made.right] == "wrong").sum() == 0
    assert made.error_m(found.world_from_cam) < made.error_m(made.odometry()) / 2


@pytest.mark.parametrize("misstated", [(0.1, 1.0), (10.0, 1.0), (1.0, 0.2), (1.0, 10.0)])
def test_stated_errors_are_believed_up_to_a_scale(misstated: tuple[float, float]) -> None:
    made = drive(misstated=misstated)
    found = diagnose(made.graph)
    assert not (found.kept & ~made.right).any()
    assert (found.kept & made.right).sum() >= made.right.sum() - 3


@pytest.mark.parametrize(("dimension", "unit"), [(2, 1e-6), (3, 1e6)])
def test_the_unit_of_the_stated_information_and_of_lengths_changes_no_verdict(dimension: int, unit: float) -> None:
    graph = drive(seed=dimension - 2, count=300, dimension=dimension, loops=80).graph
    information = graph.information
    in_other_units = replace(graph, information=unit * information)
    longer = replace(
        graph,
        i_from_j=se3.rescaled(graph.i_from_j, unit**0.5),
        information=se3.rescaled_information(information, unit**0.5),
    )
    expected = diagnose(graph)
    assert (expected.verdict == "consistent").sum() > 300
    for other in (in_other_units, longer):
        np.testing.assert_array_equal(diagnose(other).verdict, expected.verdict)


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("in_groups", [False, True])
def test_where_all_loops_are_wrong_the_backbone_comes_back(dimension: int, in_groups: bool) -> None:
    made = drive(dimension=dimension, wrong=1.0, in_groups=in_groups)
    found = diagnose(made.graph)
    assert made.error_m(found.world_from_cam) <= NEVER_WORSE * made.error_m(made.odometry())
    assert any("100 loops that nothing confirms" in note for note in found.notes)
    assert not np.isin(found.verdict[made.right], ("wrong", "suspect")).any()


def test_wrong_loops_that_agree_at_one_place_alone_confirm_nothing() -> None:
    made = drive(seed=7132, dimension=3, count=800, loops=480, wrong=1.0, in_groups=True, misstated=(0.3, 1.0))
    found = diagnose(made.graph)
    assert not (found.kept & ~made.right).any() and found.kept[made.right].all()
    assert made.error_m(found.world_from_cam) <= NEVER_WORSE * made.error_m(made.odometry())


@pytest.mark.parametrize("dimension", [2, 3])
def test_information_that_is_unknown_hides_no_right_loop(dimension: int) -> None:
    made = drive(dimension=dimension)
    diagonal = (made.graph.information != 0) & np.eye(6, dtype=bool)
    found = diagnose(replace(made.graph, information=diagonal.astype(float)))
    assert not (found.kept & ~made.right).any()
    assert (found.kept & made.right).sum() >= made.right.sum() - 3


@pytest.mark.parametrize(("dimension", "seed"), [(2, 6), (3, 7)])
def test_errors_that_drift_hides_are_learned_where_the_loops_lead(dimension: int, seed: int) -> None:
    """By the bare odometry a ninth of what these loops err by is as likely: 51 and 47 right ones then seem off."""
    made = drive(seed=seed, count=300, dimension=dimension, loops=240)
    diagonal = (made.graph.information != 0) & np.eye(6, dtype=bool)
    found = diagnose(replace(made.graph, information=diagonal.astype(float)))
    assert not (found.kept & ~made.right).any()
    assert (found.kept & made.right).sum() >= made.right.sum() - 3


@pytest.mark.parametrize(("seed", "count", "loops"), [(5036, 250, 100), (5040, 120, 60)])
def test_where_nothing_is_stated_wrong_loops_do_not_discard_the_odometry(seed: int, count: int, loops: int) -> None:
    made = drive(seed=seed, count=count, loops=loops, wrong=1.0, in_groups=True)
    diagonal = (made.graph.information != 0) & np.eye(6, dtype=bool)
    found = diagnose(replace(made.graph, information=diagonal.astype(float)))
    assert made.error_m(found.world_from_cam) <= NEVER_WORSE * made.error_m(made.odometry())


def test_a_covariance_that_sums_left_indefinite_has_a_root() -> None:
    covariance = np.array([np.diag([4.0, 1.0]), [[1.0, 1.001], [1.001, 1.0]]])
    found = cholesky(covariance)
    np.testing.assert_allclose(found @ np.swapaxes(found, 1, 2), covariance, atol=2e-3)


@pytest.mark.parametrize("share", [0.6, 1.0])
def test_random_motions_between_places_seen_again_are_not_used(share: float, data_dir: Path) -> None:
    """The first 500 poses of INTEL: 30 loops join each two places, of which a few agree by chance, 1.9 times as far off
    as the odometry. Of the 87 that are right none is lost where the others are wrong.
    """
    whole = read_graph(data_dir / "pose_graphs/sesync/intel.g2o").graph
    assert whole is not None
    rows = np.flatnonzero((whole.edges < 500).all(axis=1))
    graph = replace(whole.select(rows), vertex_ids=whole.vertex_ids[:500])
    loops = np.flatnonzero(np.diff(graph.edges, axis=1)[:, 0] != 1)
    truth = find_backbone(graph, "sequential")
    assert truth is not None
    rng = np.random.default_rng(0)
    wrong = loops[rng.random(len(loops)) < share]
    motion, right = graph.i_from_j.copy(), ~np.isin(np.arange(graph.edge_count), wrong)
    motion[wrong] = se3.exp(rng.normal(size=(len(wrong), 6)) * [0.0, 0.0, 0.7, 1.5, 1.5, 0.0])
    made = Drive(replace(graph, i_from_j=motion), truth.world_from_cam, right)
    backbone = find_backbone(made.graph)
    assert backbone is not None and backbone.used[right].all()
    ratio = made.error_m(backbone.world_from_cam) / made.error_m(made.odometry())
    assert ratio < 0.1 if share < 1 else not backbone.used[wrong].any() and ratio < 1.02


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize(("loops", "wrong", "group"), [(20, 0, 1), (5, 0, 1), (26, 60, 1), (26, 60, 10)])
def test_a_path_that_closes_once_is_closed(dimension: int, loops: int, wrong: int, group: int) -> None:
    made = round_trip(dimension - 2, loops, dimension=dimension, wrong=wrong, group=group)
    kept = diagnose(made.graph).kept
    assert kept[made.right].all() and (kept & ~made.right).sum() <= 1


@pytest.mark.parametrize("dimension", [2, 3])
def test_loops_of_one_mistaken_place_close_no_path(dimension: int) -> None:
    made = round_trip(dimension - 2, 10, dimension=dimension, only_wrong=True)
    assert not diagnose(made.graph).kept[~made.right].any()


def test_loops_that_are_stated_to_be_exact_refute_no_others(data_dir: Path) -> None:
    graph = read_graph(data_dir / "pose_graphs/sesync/MIT.g2o").graph
    assert graph is not None
    backbone = find_backbone(graph)
    assert backbone is not None and backbone.used.all()


def test_loops_that_are_judged_by_some_are_all_solved_for(monkeypatch: pytest.MonkeyPatch) -> None:
    made = drive(seed=3, count=900, world="town", wrong=0.3, loops=300)
    monkeypatch.setattr(fit, "MOST_ACTIVE", 8)
    backbone = find_backbone(made.graph)
    assert backbone is not None and len(backbone.found.reduced.active) <= 8
    assert not backbone.used[~made.right].any()
    some_m = made.error_m(backbone.found.polished[0].poses[np.argsort(backbone.chain.order)])
    assert made.error_m(backbone.world_from_cam) < 0.7 * some_m

    wrong = np.flatnonzero(~made.right)[:3]
    used = backbone.used.copy()
    used[wrong] = True
    found = of_every_loop(made.graph, replace(backbone, used=used), backbone.steps)
    assert not found.used[wrong].any() and (found.right[wrong] < WRONG_BELOW).all()
    np.testing.assert_array_equal(found.used, backbone.used)
    assert of_every_loop(made.graph, replace(backbone, used=used), used).used[wrong].all()


@pytest.mark.parametrize(("world", "count", "loops", "group"), [("ring", 150, 90, 12), ("town", 250, 150, 60)])
def test_corridors_that_are_mistaken_neither_break_the_backbone_nor_make_a_lattice(
    world: str, count: int, loops: int, group: int
) -> None:
    made = drive(world=world, count=count, loops=loops, wrong=1.0, in_groups=True, group=group)
    found = diagnose(made.graph)
    assert made.error_m(found.world_from_cam) <= NEVER_WORSE * made.error_m(made.odometry())
    assert not np.isin(found.verdict[made.right], ("wrong", "suspect")).any()


@pytest.mark.filterwarnings("error")
def test_places_that_all_contradict_each_other_are_judged_without_a_warning() -> None:
    made = drive(seed=724, world="town", loops=60, wrong=1.0, in_groups=True, misstated=(3.0, 0.5))
    assert made.error_m(diagnose(made.graph).world_from_cam) <= NEVER_WORSE * made.error_m(made.odometry())


def test_many_loops_of_one_mistaken_place_do_not_outvote_few_of_several_places() -> None:
    made = drive(seed=8203, count=800, loops=80, wrong=0.9, in_groups=True, misstated=(10.0, 10.0))
    np.testing.assert_array_equal(diagnose(made.graph).kept, made.right)


def test_groups_of_wrong_loops_do_not_outvote_the_backbone_of_a_lattice() -> None:
    made = drive(world="room", loops=300, wrong=0.1, in_groups=True)
    steps = np.abs(np.diff(made.graph.edges, axis=1)[:, 0]) == 1
    cut = np.flatnonzero(steps)[40:400:60]
    kept = ~np.isin(np.arange(made.graph.edge_count), cut)  # more edges than are right, and six steps fewer
    backbone = lattice_backbone(made.graph, kept)
    assert backbone is not None
    np.testing.assert_array_equal(backbone.used, made.right)
    assert lattice_backbone(made.graph, made.right | ~steps) is None


@pytest.mark.parametrize("wrong", [0.3, 1.0])
@pytest.mark.parametrize("short", [50, 100, 400])
def test_edges_over_a_few_steps_are_no_reason_to_doubt_the_odometry(short: int, wrong: float) -> None:
    """Groups of wrong loops are more edges than those that hold the odometry together at one step."""
    made = drive(seed=51, count=200, world="town", loops=40, wrong=wrong, in_groups=True, short=short)
    found = diagnose(made.graph)
    assert not (found.kept & ~made.right).any()
    assert made.error_m(found.world_from_cam) <= NEVER_WORSE * made.error_m(made.odometry())


@pytest.mark.parametrize("dimension", [2, 3])
def test_no_cycle_is_needed_for_a_chain_that_hangs_by_one_end_and_wrong_loops(dimension: int) -> None:
    """As in a parking garage, of whose lattice the first and the last vertices are no part."""
    made = drive(seed=1, count=300, dimension=dimension, world="room", loops=600, wrong=0.0)
    rng, count = np.random.default_rng(1), 24
    inside = (made.graph.edges < 200).all(axis=1) | (np.diff(made.graph.edges, axis=1)[:, 0] == 1)
    graph = made.graph.select(np.flatnonzero(inside))
    twist = np.zeros((count, 6))
    ends = np.stack([rng.integers(0, 190, count), rng.integers(210, 300, count)], axis=1)
    twist[:, 2], twist[:, 3:5] = rng.uniform(-np.pi, np.pi, count), rng.uniform(-30, 30, (count, 2))
    spoiled = ViewGraph.from_edges(
        graph.vertex_ids,
        np.concatenate([graph.edges, ends]),
        np.concatenate([graph.i_from_j, se3.exp(twist)]),
        np.concatenate([graph.information, np.repeat(graph.information[-1:], count, axis=0)]),
        dimension=graph.dimension,
    )
    found = diagnose(spoiled, DiagnosisOptions(trust="none"))
    assert found.kept[: graph.edge_count].all()
    assert made.error_m(found.world_from_cam) < 0.5  # 14 m where the lattice grows by single edges alone


def test_wrong_loops_between_ends_that_are_near_along_the_path_are_left_out() -> None:
    """As of places that a front end takes for the same because it has just left them."""
    made = drive(world="town", count=800, loops=40, wrong=0.0)
    rng, graph, count = np.random.default_rng(0), made.graph, 150
    first = rng.integers(0, 780, count)
    twist = np.zeros((count, 6))
    twist[:, 2:5] = rng.normal(size=(count, 3)) * [np.radians(10), 0.3, 0.3]
    spoiled = ViewGraph.from_edges(
        graph.vertex_ids,
        np.concatenate([graph.edges, np.stack([first, first + rng.integers(5, 20, count)], axis=1)]),
        np.concatenate([graph.i_from_j, se3.exp(twist)]),
        np.concatenate([graph.information, np.repeat(graph.information[-1:], count, axis=0)]),
        dimension=2,
    )
    backbone = find_backbone(spoiled)
    assert backbone is not None and backbone.used[: graph.edge_count].all()
    assert not backbone.used[graph.edge_count :].any()


def test_right_places_that_are_registered_wrong_do_not_widen_the_errors_of_all_loops() -> None:
    """Nine tenths of the loops, by .4 rad and two steps."""
    made = drive(count=300, loops=15, wrong=0.0)
    rng, graph, count = np.random.default_rng(0), made.graph, 140
    near = np.sort(cKDTree(made.truth[:, :3, 3]).query_pairs(5.0, output_type="ndarray"), axis=1)
    ends = rng.choice(near[np.diff(near, axis=1)[:, 0] > 1], count, replace=False)
    off = rng.normal(size=(count, 6)) * [0, 0, 0.4, 2, 2, 0]
    motions = se3.inverse(made.truth[ends[:, 0]]) @ made.truth[ends[:, 1]] @ se3.exp(off)
    spoiled = ViewGraph.from_edges(
        graph.vertex_ids,
        np.concatenate([graph.edges, ends]),
        np.concatenate([graph.i_from_j, motions]),
        np.concatenate([graph.information, np.repeat(graph.information[-1:], count, axis=0)]),
        dimension=2,
    )
    backbone = find_backbone(spoiled)
    assert backbone is not None and not backbone.doubted and (~backbone.used[: graph.edge_count]).sum() <= 1
    assert backbone.used[graph.edge_count :].mean() < 0.02
    assert made.error_m(backbone.world_from_cam) < 0.3 * made.error_m(made.odometry())


def test_edges_written_the_other_way_round_change_nothing() -> None:
    one, other = (diagnose(drive(turned=turned).graph) for turned in (False, True))
    np.testing.assert_array_equal(one.verdict, other.verdict)
    # maximum likelihood measures translations in the frame that an edge begins in
    np.testing.assert_allclose(one.world_from_cam, other.world_from_cam, atol=1e-4)


def test_the_order_of_edges_in_the_file_changes_nothing(data_dir: Path) -> None:
    graph = read_graph(data_dir / "pose_graphs/slam_loops/bicocca/B25b_0.500.g2o").graph
    assert graph is not None
    order = np.random.default_rng(3).permutation(graph.edge_count)
    one, other = find_backbone(graph), find_backbone(graph.select(order))
    assert one is not None and other is not None
    np.testing.assert_array_equal(other.used, one.used[order])
    np.testing.assert_allclose(other.right, one.right[order], atol=1e-6)
    np.testing.assert_allclose(other.world_from_cam, one.world_from_cam, atol=1e-6)


def test_solvers_and_the_diagnosis_agree() -> None:
    made = drive()
    found = diagnose(made.graph)
    start = np.tile(np.eye(4), (made.graph.vertex_count, 1, 1))
    for solution in (solve_robust(made.graph), RobustSolver().solve(made.graph, start)):
        np.testing.assert_array_equal(solution.weights > 0, found.kept)
        assert solution.confirmed
        assert made.error_m(solution.world_from_cam) < 1.1 * made.error_m(found.world_from_cam)
        np.testing.assert_allclose(solution.world_from_cam[0], np.eye(4), atol=1e-9)


def test_more_loops_than_can_be_inverted_are_judged_at_the_poses_of_some(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fit, "MOST_UNKNOWNS", 150)
    made = drive(count=1500, dimension=3, world="town", loops=700)
    chain = chain_of(made.graph)
    right = np.flatnonzero(made.right[chain.loop_edge])
    some = fit.thinned(chain, right)
    assert 0 < len(some.active) < len(right)
    assert (some.network.plan.size - some.network.plan.core) * 6 <= 150
    found = find_backbone(made.graph)
    assert found is not None
    assert not (found.used & ~made.right).any()
    assert found.used[made.right].mean() > 0.95
    assert made.error_m(found.world_from_cam) < made.error_m(made.odometry())
