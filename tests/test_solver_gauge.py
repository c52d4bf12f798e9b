"""What is held while the rest moves: components, fixed vertices, priors; the stage, and its limits."""

import dataclasses

import numpy as np
import pytest

from hodge_paper.solver import PaperSolver
from hodge_pipeline import se3
from hodge_pipeline.diagnosis.robust import RobustSolver
from hodge_pipeline.errors import GraphError
from hodge_pipeline.solvers.covariance import marginal_covariances
from hodge_pipeline.solvers.editing import GraphEditor
from hodge_pipeline.solvers.maximum_likelihood import MaximumLikelihoodSolver, solve
from hodge_pipeline.solvers.poisson import PoissonSolver
from hodge_pipeline.types import Priors, ViewGraph
from solver_graphs import ladder


def test_fixed_vertices_stay():
    graph, truth = ladder(0.1)
    fixed = np.array([0, 5, 11])
    solution = solve(graph, start=truth, fixed=fixed)
    np.testing.assert_allclose(solution.world_from_cam[fixed], truth[fixed], atol=1e-12)
    free = solve(graph, start=truth)
    assert solution.metrics["objective"] > free.metrics["objective"]


def test_limits_give_the_best_so_far_and_say_so():
    graph, _ = ladder(0.5)
    one = solve(graph, max_iterations=1, objective="isotropic")
    best = solve(graph, objective="isotropic")
    assert any("iteration limit reached" in note for note in one.notes)
    assert one.converged is False
    assert best.metrics["objective"] < one.metrics["objective"]
    late = solve(graph, time_limit_s=1e-9, objective="isotropic")
    assert any("time limit reached" in note for note in late.notes)


def test_the_history_of_the_stage_ends_with_its_result():
    solution = MaximumLikelihoodSolver().solve(*ladder(0.1))
    assert solution.history[-1].objective == solution.metrics["objective"]
    np.testing.assert_array_equal(solution.history[-1].world_from_cam, solution.world_from_cam)


def test_priors_are_edges_from_the_world():
    """Two ends of a rail are known, one of them twice as well: the rail is stretched between them."""
    edges = np.array([(0, 1), (1, 2)])
    motion = np.tile(se3.from_parts(np.eye(3), np.array([1.0, 0, 0])), (2, 1, 1))
    graph = ViewGraph.from_edges(np.array(["a", "b", "c"]), edges, motion)
    known = np.stack([np.eye(4), se3.from_parts(np.eye(3), np.array([3.0, 0, 0]))])
    priors = Priors(np.array([0, 2]), known, np.stack([np.eye(6), 2 * np.eye(6)]))
    solution = solve(graph, priors=priors)
    force = 1 / (1 + 1 + 1 + 1 / 2)  # springs in a row, and a metre between their natural length and the ends
    np.testing.assert_allclose(solution.world_from_cam[:, 0, 3], [force, 1 + 2 * force, 2 + 3 * force], atol=1e-7)
    assert solution.metrics["objective"] == pytest.approx(force**2 * 3.5, rel=1e-6)
    assert len(solution.weights) == 2
    assert all(len(step.world_from_cam) == 3 for step in solve(graph, priors=priors, keep_history=True).history)
    for outside in (3, 7, -1):
        with pytest.raises(GraphError, match=f"prior 1 names vertex row {outside} of 3"):
            solve(graph, priors=Priors(np.array([0, outside]), known, priors.information))


def test_priors_join_pieces_and_can_be_certified():
    graph, truth = ladder(0.0)
    half = graph.select(np.flatnonzero((graph.edges < 6).all(axis=1) | (graph.edges >= 6).all(axis=1)))
    priors = Priors(np.array([0, 7]), truth[[0, 7]], np.tile(np.eye(6), (2, 1, 1)))
    solution = solve(half, priors=priors, objective="isotropic", certificate=True)
    np.testing.assert_allclose(solution.world_from_cam, truth, atol=1e-6)
    assert solution.component.max() == 0
    assert solution.certified is True


def test_the_graph_says_what_is_fixed_and_in_which_plane():
    graph, truth = ladder(0.1, planar=True)
    held = dataclasses.replace(graph, fixed=np.array([3, 7]), dimension=2)
    solution = solve(held, start=truth)
    np.testing.assert_allclose(solution.world_from_cam[[3, 7]], truth[[3, 7]], atol=1e-12)
    assert solution.metrics["objective_at_start"] > solution.metrics["objective"]
    assert any("2 fixed vertices have no pose" in note for note in solve(held).notes)


def stretched() -> tuple[ViewGraph, np.ndarray]:
    """Three vertices in a row, a metre apart as measured, the ends held three metres apart; the middle starts off."""
    step = np.tile(se3.from_parts(np.eye(3), np.array([1.0, 0, 0])), (2, 1, 1))
    graph = ViewGraph.from_edges(np.array([5, 6, 7]), np.array([(0, 1), (1, 2)]), step, fixed=np.array([0, 2]))
    start = np.tile(np.eye(4), (3, 1, 1))
    start[:, 0, 3] = [10.0, 10.4, 13.0]
    return graph, start


@pytest.mark.parametrize("solver", [MaximumLikelihoodSolver(), PoissonSolver(), PaperSolver(), RobustSolver()])
def test_between_fixed_ends_the_disagreement_is_shared(solver):
    graph, start = stretched()
    solution = solver.solve(graph, start)
    np.testing.assert_allclose(solution.world_from_cam[:, 0, 3], [10, 11.5, 13], atol=1e-9)
    np.testing.assert_array_equal(solution.world_from_cam[[0, 2]], start[[0, 2]])


@pytest.mark.parametrize("solver", [PoissonSolver(inner_iterations=12), PaperSolver(inner_iterations=12)])
def test_a_component_without_a_fixed_vertex_keeps_its_first_one(solver):
    graph, truth = ladder(0.0)
    both = ViewGraph.from_edges(
        np.arange(24),
        np.concatenate([graph.edges, graph.edges + 12]),
        np.concatenate([graph.i_from_j] * 2),
        fixed=np.array([14]),
    )
    rng = np.random.default_rng(0)
    far = se3.exp(np.array([0.1, 0.2, 0.3, 5, 0, 0]))
    start = np.concatenate([truth, far @ truth]) @ se3.exp(0.02 * rng.normal(size=(24, 6)))
    start[0], start[14] = truth[0], far @ truth[2]
    poses = solver.solve(both, start).world_from_cam
    np.testing.assert_allclose(poses, np.concatenate([truth, far @ truth]), atol=1e-6)


@pytest.mark.parametrize("solver", [PoissonSolver(), PaperSolver()])
def test_solvers_without_a_term_for_priors_refuse_them(solver):
    graph, truth = ladder(0.1)
    priors = Priors(np.array([0]), truth[:1], np.eye(6)[None])
    with pytest.raises(
        GraphError, match=r"no term for priors of single poses \(1 given\): take solver maximum_likelihood"
    ):
        solver.solve(dataclasses.replace(graph, priors=priors), truth)
    none = Priors(np.zeros(0, np.int64), np.zeros((0, 4, 4)), np.zeros((0, 6, 6)))
    solver.solve(dataclasses.replace(graph, priors=none), truth)


def test_an_editor_leaves_fixed_vertices_where_they_are():
    graph, truth = ladder(0.1)
    graph = dataclasses.replace(graph, fixed=np.array([0, 5, 11]))
    editor = GraphEditor(graph, solve(graph, start=truth))
    editor.reweight([3, 10], 0.1)
    found = editor.solve()
    np.testing.assert_allclose(found.world_from_cam[[0, 5, 11]], truth[[0, 5, 11]], atol=1e-12)
    weighed = graph.information.copy()
    weighed[[3, 10]] *= 0.1
    fresh = solve(dataclasses.replace(graph, information=weighed), start=truth)
    np.testing.assert_allclose(found.world_from_cam, fresh.world_from_cam, atol=1e-4)
    without = GraphEditor(graph)
    assert any("3 fixed vertices have no pose" in note for note in without.solution.notes)
    without.add(np.array([[0, 11]]), se3.inverse(truth[:1]) @ truth[11:])
    without.solve()
    free = GraphEditor(dataclasses.replace(graph, fixed=np.zeros(0, np.int64)))
    free.add(np.array([[0, 11]]), se3.inverse(truth[:1]) @ truth[11:])
    assert without.solution.metrics["objective"] == pytest.approx(free.solve().metrics["objective"], rel=1e-6)


def test_covariances_know_what_is_fixed_and_what_priors_say():
    graph, start = stretched()
    between = marginal_covariances(graph, solve(graph, start=start).world_from_cam, np.arange(3))
    assert not between[[0, 2]].any()
    free = marginal_covariances(dataclasses.replace(graph, fixed=np.array([0])), start, np.arange(3))
    # a spring on either side of the middle, at first without the lever of a rotation: half the variance of one
    np.testing.assert_allclose(between[1, 3, 3], 0.5, rtol=1e-6)
    np.testing.assert_allclose(free[1, 3, 3], 1.0, rtol=1e-6)
    priors = Priors(np.array([0]), start[:1], 4 * np.eye(6)[None])
    known = dataclasses.replace(graph, fixed=np.zeros(0, np.int64), priors=priors)
    loose = marginal_covariances(known, solve(known).world_from_cam, np.arange(3))
    np.testing.assert_allclose(loose[0], 0.25 * np.eye(6), atol=1e-9)
    np.testing.assert_allclose(loose[1, 3, 3], 1.25, rtol=1e-6)


def test_pieces_are_in_order_of_size_where_there_are_priors():
    """0—1, 2—3—4—5, 6; priors on 0, 1 and 6 make a piece of three, which is four with the world."""
    edges = np.array([(0, 1), (2, 3), (3, 4), (4, 5)])
    graph = ViewGraph.from_edges(np.arange(7), edges, np.tile(np.eye(4), (4, 1, 1)))
    for known, expected in (([0, 1, 6], [1, 1, 0, 0, 0, 0, 1]), ([6], [1, 1, 0, 0, 0, 0, 2])):
        count = len(known)
        priors = Priors(np.array(known), np.tile(np.eye(4), (count, 1, 1)), np.tile(np.eye(6), (count, 1, 1)))
        assert solve(graph, priors=priors).component.tolist() == expected
