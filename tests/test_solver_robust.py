import dataclasses
from pathlib import Path

import numpy as np
import pytest

from diagnosis_graphs import SIGMA, measured, near_pairs, poses_on_a_ring
from hodge_pipeline import open_source, se3
from hodge_pipeline.diagnosis.options import DiagnosisOptions
from hodge_pipeline.diagnosis.robust import RobustSolver, solve_robust
from hodge_pipeline.errors import GraphError
from hodge_pipeline.solvers.covariance import marginal_covariances, relative_covariances
from hodge_pipeline.solvers.maximum_likelihood import MaximumLikelihoodSolver, solve
from hodge_pipeline.types import Priors, ViewGraph

SIGMA_RAD, SIGMA_M = 0.01, 0.02


def band(count: int, reach: int, seed: int, planar: bool = False) -> tuple[ViewGraph, np.ndarray]:
    """Each vertex joined to the next `reach` ones, and the true poses."""
    rng = np.random.default_rng(seed)
    twists = rng.normal(size=(count, 6))
    edges = np.array([(i, i + s) for s in range(1, reach + 1) for i in range(count - s)])
    errors = rng.normal(size=(len(edges), 6)) * np.repeat([SIGMA_RAD, SIGMA_M], 3)
    information = np.tile(np.diag(np.repeat([SIGMA_RAD**-2, SIGMA_M**-2], 3)), (len(edges), 1, 1))
    if planar:
        twists[:, [0, 1, 5]] = errors[:, [0, 1, 5]] = 0
        information[:, [0, 1, 5]] = 0
    truth = se3.exp(twists)
    measured = se3.inverse(truth[edges[:, 0]]) @ truth[edges[:, 1]] @ se3.exp(errors)
    return ViewGraph.from_edges(np.arange(count), edges, measured, information), truth


def spoiled(graph: ViewGraph, share: float, seed: int) -> tuple[ViewGraph, np.ndarray]:
    """The graph with a share of its edges wrong, and which."""
    rng = np.random.default_rng(seed)
    wrong = rng.random(graph.edge_count) < share
    motion = graph.i_from_j.copy()
    motion[wrong] = se3.exp(rng.normal(size=(int(wrong.sum()), 6)))
    if not graph.information[:, 0].any():
        motion[wrong] = se3.exp(rng.normal(size=(int(wrong.sum()), 6)) * np.array([0, 0, 1, 1, 1, 0]))
    return dataclasses.replace(graph, i_from_j=motion), wrong


@pytest.mark.parametrize("planar", [False, True])
@pytest.mark.parametrize("share", [0.0, 0.2, 0.4])
def test_wrong_edges_are_found_and_left_out(share, planar):
    graph, truth = band(30, 8, 1, planar)
    graph, wrong = spoiled(graph, share, 2)
    solution = solve_robust(graph, start=truth)
    kept = solution.weights > 0
    assert not kept[wrong].any()
    assert kept[~wrong].mean() > 0.93
    main = solution.component == 0
    assert main.sum() >= 29
    relative = se3.inverse(truth[main]) @ solution.world_from_cam[main]
    assert np.abs(relative - np.eye(4)).max() < 0.1
    assert any(f"{kept.sum()} of {graph.edge_count} edges kept" in note for note in solution.notes)


def rings(count: int, around: int) -> tuple[ViewGraph, np.ndarray]:
    """A cylinder of rings of so many poses, each joined to the ring below twice, and the true poses."""
    k = np.arange(count)
    angle = 2 * np.pi * k / around
    place = np.stack([np.cos(angle), np.sin(angle), 2 * np.pi * k / around**2], axis=1) * around / (2 * np.pi)
    truth = se3.from_parts(se3.so3_exp(np.outer(angle, [0, 0, 1])), place)
    edges = np.concatenate([np.stack([k[:-s], k[s:]], axis=1) for s in (1, around, around + 1)])
    sigma = np.repeat([0.05, 0.1], 3)
    errors = np.random.default_rng(0).normal(size=(len(edges), 6)) * sigma
    measured = se3.inverse(truth[edges[:, 0]]) @ truth[edges[:, 1]] @ se3.exp(errors)
    return ViewGraph.from_edges(k, edges, measured, np.tile(np.diag(sigma**-2), (len(edges), 1, 1))), truth


def test_right_edges_of_a_drifting_graph_are_not_lost():
    """Noise bends the rings so far that edges which close them look wrong until the others hold the shape."""
    graph, truth = rings(120, 30)
    graph, wrong = spoiled(graph, 0.2, 14)
    kept = solve_robust(graph, start=truth).weights > 0
    assert kept[wrong].mean() < 0.025  # one of 64
    assert kept[~wrong].mean() > 0.97


def test_a_wrong_sequential_edge_is_not_trusted():
    graph, truth = band(12, 4, 3)
    motion = graph.i_from_j.copy()
    motion[5] = se3.exp(np.ones(6))
    solution = solve_robust(dataclasses.replace(graph, i_from_j=motion), start=truth)
    assert solution.weights[5] == 0
    assert (np.delete(solution.weights, 5) > 0).mean() > 0.95


def test_smooth_weights_lie_between():
    graph, truth = band(20, 6, 4)
    graph, wrong = spoiled(graph, 0.2, 5)
    graph = dataclasses.replace(graph, information=4 * graph.information)  # which the errors of right edges belie
    weights = solve_robust(graph, start=truth).weights
    assert weights[wrong].max() == 0
    assert np.median(weights[~wrong]) > 0.9
    assert ((weights > 0.05) & (weights < 0.95)).any()


@pytest.mark.parametrize("stated", [1.0, 0.1])
@pytest.mark.parametrize("trust", ["auto", "none"])  # on a backbone, and judged by cycles
def test_a_graph_whose_information_explains_it_is_solved_as_stated(trust, stated):
    graph, _ = rings(200, 40)
    graph = dataclasses.replace(graph, information=stated * graph.information)
    solution = solve_robust(graph, diagnosis=DiagnosisOptions(trust=trust))
    used = solution.weights > 0
    assert used.mean() > 0.95
    np.testing.assert_array_equal(solution.weights[used], 1)
    plain = solve(graph.select(np.flatnonzero(used))).world_from_cam
    from_first = se3.inverse(solution.world_from_cam[0]) @ solution.world_from_cam
    np.testing.assert_allclose(from_first, se3.inverse(plain[0]) @ plain, atol=1e-3)


@pytest.mark.parametrize("planar", [False, True])
@pytest.mark.parametrize("stated", [1.0, 0.01])  # whatever the scale of the information
def test_tails_of_registered_edges_are_weighed(planar, stated):
    graph, truth = band(40, 6, 7, planar)
    rng = np.random.default_rng(8)
    long = rng.random(graph.edge_count) < 0.1
    more = rng.normal(size=(graph.edge_count, 6)) * np.repeat([SIGMA_RAD, SIGMA_M], 3) * 8 * long[:, None]
    if planar:
        more[:, [0, 1, 5]] = 0
    spread = dataclasses.replace(graph, i_from_j=graph.i_from_j @ se3.exp(more), information=stated * graph.information)
    found = {tails: MaximumLikelihoodSolver(tails=tails).solve(spread, truth) for tails in ("gaussian", "student")}
    error = {tails: np.abs(se3.inverse(truth) @ one.world_from_cam - np.eye(4)).mean() for tails, one in found.items()}
    assert error["student"] < 0.7 * error["gaussian"]
    weights = found["student"].weights
    assert weights.min() > 0 and np.median(weights[long]) < 0.3 and np.median(weights[~long]) > 0.9


def test_what_only_wrong_edges_join_falls_apart():
    left, truth = band(8, 4, 6)
    bridges = np.array([(0, 9), (4, 12), (7, 15)])
    wild = se3.exp(np.random.default_rng(7).normal(size=(3, 6)))
    graph = ViewGraph.from_edges(
        np.arange(16),
        np.concatenate([left.edges, left.edges + 8, bridges]),
        np.concatenate([left.i_from_j, left.i_from_j, wild]),
        np.concatenate([left.information, left.information, left.information[:3]]),
    )
    solution = solve_robust(graph, start=np.concatenate([truth, truth]))
    assert np.isfinite(solution.world_from_cam).all()
    assert (solution.weights[-3:] > 0).sum() <= 1
    assert (solution.weights[:-3] > 0).mean() > 0.9


def test_the_covariance_of_a_chain_adds_up():
    """0 → 1 → 2: the second pose has its own edge's covariance and the first one's, moved."""
    graph, truth = band(3, 1, 9)
    own = np.linalg.inv(graph.information)
    exact = solve(graph, start=truth).world_from_cam
    found = marginal_covariances(graph, exact, np.arange(3))
    moved = se3.adjoint(se3.inverse(exact[2]) @ exact[1])
    np.testing.assert_array_equal(found[0], np.zeros((6, 6)))
    np.testing.assert_allclose(found[1], own[0], rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(found[2], own[1] + moved @ own[0] @ moved.T, rtol=1e-6, atol=1e-10)
    np.testing.assert_allclose(relative_covariances(graph, exact, np.array([[0, 2]]))[0], found[2], atol=1e-10)
    np.testing.assert_allclose(relative_covariances(graph, exact, np.array([[1, 2]]))[0], own[1], atol=1e-10)


@pytest.mark.parametrize("planar", [False, True])
def test_covariances_match_many_solves(planar):
    graph, truth = band(6, 3, 10, planar)
    clean = se3.inverse(truth[graph.edges[:, 0]]) @ truth[graph.edges[:, 1]]
    rng = np.random.default_rng(11)
    errors = np.repeat([SIGMA_RAD, SIGMA_M], 3) * np.array([0, 0, 1, 1, 1, 0] if planar else [1] * 6)
    seen = []
    for _ in range(150):
        noisy = clean @ se3.exp(errors * rng.normal(size=(graph.edge_count, 6)))
        poses = solve(dataclasses.replace(graph, i_from_j=noisy), start=truth).world_from_cam
        seen.append(se3.log(se3.inverse(truth[5]) @ poses[5]))
    sampled = np.cov(np.array(seen).T)
    predicted = marginal_covariances(dataclasses.replace(graph, i_from_j=clean), truth, np.array([5]))[0]
    np.testing.assert_allclose(np.diag(sampled), np.diag(predicted), rtol=0.35, atol=1e-12)


def test_vertices_in_two_components_have_no_relative_covariance():
    graph, truth = band(4, 1, 12)
    with pytest.raises(GraphError, match="two components"):
        relative_covariances(graph.select(np.array([0, 2])), truth, np.array([[0, 3]]))


def test_fixed_vertices_without_a_start_hold_nothing_and_a_note_says_so():
    """They were held where the rounds before the last solve had put them."""
    graph, _ = band(16, 3, 0)
    free = solve_robust(graph)
    held = solve_robust(dataclasses.replace(graph, fixed=np.array([0, 7, 15])))
    np.testing.assert_allclose(held.world_from_cam, free.world_from_cam, atol=1e-9)
    assert any("3 fixed vertices have no pose" in note for note in held.notes)


def test_weights_are_those_of_the_last_solve():
    graph, truth = band(20, 6, 4)
    graph, _ = spoiled(graph, 0.2, 5)
    solution = solve_robust(graph, start=truth)
    assert (solution.weights <= 1).all()
    assert int((solution.weights > 0).sum()) == solution.metrics["kept_edges"]
    weighted = dataclasses.replace(graph, information=solution.weights[:, None, None] * graph.information)
    again = solve(weighted, start=solution.world_from_cam)
    np.testing.assert_allclose(again.metrics["chi2"], solution.metrics["chi2"], rtol=1e-8)


def random_edges(seed: int) -> ViewGraph:
    """24 random motions between 8 to 12 vertices."""
    rng, count = np.random.default_rng(seed), 8 + seed % 5
    edges = np.array([rng.choice(count, 2, replace=False) for _ in range(24)])
    motions = se3.exp(rng.normal(size=(24, 6)) * np.repeat([1.5, 2.0], 3))
    information = np.diag(np.repeat([SIGMA_RAD**-2, SIGMA_M**-2], 3))
    return ViewGraph.from_edges(np.arange(count), edges, motions, np.tile(information, (24, 1, 1)))


@pytest.mark.parametrize("seed", range(10))
def test_a_tree_of_random_edges_is_not_confirmed(seed):
    graph = random_edges(seed)
    solution = RobustSolver().solve(graph, np.tile(np.eye(4), (graph.vertex_count, 1, 1)))
    assert solution.confirmed is False
    assert "nothing confirms" in solution.notes[0]


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("share", [0.0, 0.2])
def test_right_edges_with_loops_are_confirmed(seed, share):
    graph, truth = band(12, 3, seed)
    assert solve_robust(spoiled(graph, share, seed)[0], start=truth).confirmed is True


def test_a_tree_is_tested_by_nothing_and_refuted_by_nothing():
    graph, truth = band(12, 1, 3)
    solution = solve_robust(graph, start=truth)
    assert solution.confirmed is None
    assert "nothing tests the edges" in solution.notes[-1]
    wrong = ViewGraph.from_edges(
        graph.vertex_ids,
        np.concatenate([graph.edges, [(0, 6), (2, 9), (11, 4)]]),
        np.concatenate([graph.i_from_j, se3.exp(np.random.default_rng(4).normal(size=(3, 6)))]),
        np.concatenate([graph.information, graph.information[:3]]),
    )
    assert solve_robust(wrong, start=truth, diagnosis=DiagnosisOptions(trust="none")).confirmed is False


@pytest.mark.parametrize(("off_m", "confirmed"), [(0.0, True), (0.15, None), (1.0, False)])
def test_a_ring_is_not_confirmed_that_is_open_by_more_than_it_states(off_m, confirmed):
    """Nothing tells which of its three edges is wrong, and none is left out."""
    steps = np.tile(se3.exp(np.array([0, 0, 2 * np.pi / 3, 1.0, 0, 0])), (3, 1, 1))
    steps[2, 0, 3] += off_m
    pairs = np.array([[0, 1], [1, 2], [2, 0]])
    graph = ViewGraph.from_edges(np.arange(3), pairs, steps, np.tile(np.eye(6) / 0.05**2, (3, 1, 1)))
    solution = solve_robust(graph)
    assert solution.kept.all() and solution.confirmed is confirmed


def test_rounding_along_a_path_leaves_no_edge_out():
    """Unstated information takes its size from what the poses leave over, of a path without loops rounding alone."""
    steps = se3.exp(0.3 * np.random.default_rng(0).normal(size=(3000, 6)))
    pairs = np.arange(3000)[:, None] + [0, 1]
    graph = ViewGraph.from_edges(np.arange(3001), pairs, steps, np.tile(np.eye(6), (3000, 1, 1)))
    solution = solve_robust(graph)
    assert solution.kept.all() and solution.confirmed is None
    assert not solution.component.any()


def test_an_edge_of_a_vertex_to_itself_is_none_that_was_left_out():
    """A ring and a chord that confirm too little on their own: with nothing left out, nothing is in doubt."""
    graph, truth = band(5, 1, 3)
    looped = ViewGraph.from_edges(
        graph.vertex_ids,
        np.concatenate([graph.edges, [(2, 2)]]),
        np.concatenate([graph.i_from_j, graph.i_from_j[:1]]),
        np.concatenate([graph.information, graph.information[:1]]),
    )
    assert solve_robust(looped, start=truth).confirmed is solve_robust(graph, start=truth).confirmed is None


def test_a_ring_in_the_plane_with_noise_out_of_it_is_confirmed():
    rng = np.random.default_rng(0)
    turn = 2 * np.pi * np.arange(60) / 60
    truth = se3.exp(np.outer(turn + np.pi / 2, [0, 0, 1.0, 0, 0, 0]))
    truth[:, :2, 3] = 3 * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    edges = np.sort([(i, (i + ahead) % 60) for i in range(60) for ahead in range(1, 5)], axis=1)
    motions = se3.inverse(truth[edges[:, 0]]) @ truth[edges[:, 1]] @ se3.exp(0.003 * rng.normal(size=(240, 6)))
    motions[::40] = motions[::40] @ se3.exp(np.array([0, 0, 1.0, 2.0, -2.0, 0]))
    graph = ViewGraph.from_edges(np.arange(60), edges, motions, np.tile(np.eye(6) / 0.003**2, (240, 1, 1)))
    solution = solve_robust(graph)
    assert solution.confirmed is True
    np.testing.assert_array_equal(np.flatnonzero(solution.weights == 0), np.arange(0, 240, 40))


def test_edges_of_very_different_lengths_are_kept_and_confirmed(data_dir: Path) -> None:
    """At the optimum nearly all edges are far within what their information states: the first 2000 of 5750 poses."""
    whole = open_source(data_dir / "pose_graphs/sesync/cubicle.g2o").graph
    assert whole is not None
    inside = np.flatnonzero((whole.edges < 2000).all(axis=1))
    edges, motions, information = whole.edges[inside], whole.i_from_j[inside], whole.information[inside]
    solution = solve_robust(ViewGraph.from_edges(whole.vertex_ids[:2000], edges, motions, information))
    assert solution.confirmed is True and (solution.weights == 0).mean() < 0.004


def test_random_loops_in_a_large_lattice_are_left_out(data_dir: Path) -> None:
    """Too many loops to count at once, a tenth of them random: 7 of these were kept, 14 right ones lost."""
    graph = open_source(data_dir / "pose_graphs/sesync/sphere2500.g2o").graph
    assert graph is not None
    rng, count = np.random.default_rng(0), 272
    pairs = rng.integers(0, graph.vertex_count, (count, 2))
    pairs[:, 1] = np.where(np.abs(pairs[:, 0] - pairs[:, 1]) < 2, (pairs[:, 0] + 100) % graph.vertex_count, pairs[:, 1])
    wrong = se3.exp(np.concatenate([rng.normal(0, 1.5, (count, 3)), rng.normal(0, 50, (count, 3))], axis=1))
    spoiled = ViewGraph.from_edges(
        graph.vertex_ids,
        np.concatenate([graph.edges, pairs]),
        np.concatenate([graph.i_from_j, wrong]),
        np.concatenate([graph.information, np.repeat(graph.information[:1], count, axis=0)]),
    )
    kept = solve_robust(spoiled).weights > 0
    assert kept[: graph.edge_count].all() and not kept[graph.edge_count :].any()


def ring_of_three(stated: float = 1.0) -> tuple[ViewGraph, np.ndarray]:
    """Forty poses, each joined to the next three, with `stated` times the errors that they have; and the true poses."""
    truth = poses_on_a_ring(40)
    graph = measured(truth, near_pairs(40, 3), 1)
    information = np.tile(np.diag((stated * SIGMA) ** -2), (graph.edge_count, 1, 1))
    return dataclasses.replace(graph, information=information), truth


@pytest.mark.parametrize("known", ["priors", "fixed"])
def test_right_edges_count_in_full_whatever_else_is_known(known: str) -> None:
    """Of 120 right edges 45 to 49 were weighed less: the freedom of what χ² is judged by was miscounted."""
    graph, truth = ring_of_three()
    if known == "priors":
        sigma = np.full(6, 0.05)
        poses = truth @ se3.exp(np.random.default_rng(3).normal(size=(40, 6)) * sigma)
        graph = dataclasses.replace(graph, priors=Priors(np.arange(40), poses, np.tile(np.diag(sigma**-2), (40, 1, 1))))
    else:
        graph = dataclasses.replace(graph, fixed=np.arange(39))
    assert (solve_robust(graph, start=truth, diagnosis=DiagnosisOptions(trust="none")).weights == 1).all()


def test_edges_from_a_vertex_to_itself_hide_no_larger_errors() -> None:
    graph, _ = ring_of_three(stated=0.5)
    nothing = np.tile(np.eye(4), (2000, 1, 1))
    own = ViewGraph.from_edges(graph.vertex_ids, np.zeros((2000, 2), int), nothing, graph.information[[0] * 2000])
    options = DiagnosisOptions(trust="none")
    alone, found = (solve_robust(each, diagnosis=options).weights for each in (graph, ViewGraph.joined([graph, own])))
    assert (alone < 0.9).any()
    np.testing.assert_allclose(found[:120], alone, atol=1e-6)
