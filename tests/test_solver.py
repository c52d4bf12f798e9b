"""The minimum of the maximum-likelihood objectives: certified optima, derivatives, invariances."""

import dataclasses
import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hodge_pipeline import se3
from hodge_pipeline.solvers import minimise
from hodge_pipeline.solvers.full_information import full_residuals
from hodge_pipeline.solvers.maximum_likelihood import solve
from hodge_pipeline.solvers.objective import best_translations, quadratic_model, residuals, rotation_gradient
from hodge_pipeline.solvers.rotations import exponential, project
from hodge_pipeline.solvers.setup import prepare
from hodge_pipeline.types import ViewGraph
from solver_graphs import CERTIFIED_OPTIMA, as_sesync_reads_it, ladder


@pytest.mark.parametrize("name", CERTIFIED_OPTIMA)
def test_certified_optima_of_the_literature_are_reached(data_dir, name):
    solution = solve(as_sesync_reads_it(data_dir, name), objective="isotropic", certificate=True)
    assert solution.metrics["objective"] == pytest.approx(CERTIFIED_OPTIMA[name], rel=1e-8)
    assert solution.converged is True
    assert solution.certified is True


@pytest.mark.parametrize("objective", ["isotropic", "full"])
@pytest.mark.parametrize("planar", [False, True])
def test_consistent_edges_give_the_truth(objective, planar):
    graph, truth = ladder(0.0, planar=planar)
    solution = solve(graph, objective=objective)
    np.testing.assert_allclose(solution.world_from_cam, truth, atol=1e-7)
    assert solution.metrics["objective"] < 1e-12


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 10**6), planar=st.booleans(), objective=st.sampled_from(["isotropic", "full"]))
def test_the_answer_does_not_depend_on_the_world_or_the_numbering(seed, planar, objective):
    graph, truth = ladder(0.1, seed, planar=planar)
    rng = np.random.default_rng(seed + 1)
    world = se3.exp(rng.normal(size=6))
    rank = rng.permutation(graph.vertex_count)
    shuffled = rng.permutation(graph.edge_count)
    relabelled = dataclasses.replace(graph, edges=rank[graph.edges]).select(shuffled)
    one = solve(graph, start=truth, objective=objective, relative_tolerance=1e-12)
    moved_start = np.empty_like(truth)
    moved_start[rank] = world @ truth
    two = solve(relabelled, start=moved_start, objective=objective, relative_tolerance=1e-12)
    assert two.metrics["objective"] == pytest.approx(one.metrics["objective"], rel=1e-8)
    first = one.world_from_cam
    second = two.world_from_cam[rank]
    np.testing.assert_allclose(se3.inverse(second[:1]) @ second, se3.inverse(first[:1]) @ first, atol=1e-5)


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 10**6), planar=st.booleans())
def test_derivatives_match_differences(seed, planar):
    graph, _ = ladder(0.3, seed, planar=planar)
    problem = prepare(graph).problem
    rng = np.random.default_rng(seed)
    n, p, free = problem.count, problem.tangent_size, problem.free_count
    rotations = exponential(rng.normal(size=(n, p)))
    translations = rng.normal(size=(n, problem.dimension))

    def at(omega):
        turned = rotations.copy()
        turned[:free] = exponential(omega) @ rotations[:free]
        best = best_translations(problem, turned, translations)
        return residuals(problem, turned, best)

    left, direction, h = at(np.zeros((free, p))), rng.normal(size=(free, p)), 1e-3
    plus, minus = at(h * direction).cost, at(-h * direction).cost
    gradient = 2 * np.vdot(rotation_gradient(problem, left), direction)
    assert gradient == pytest.approx((plus - minus) / (2 * h), rel=1e-4, abs=1e-4 * left.cost)
    model, flat = quadratic_model(problem, left), direction.reshape(-1)
    coupled = problem.translation_factor.solve((model.coupling @ flat).reshape(free, -1)).reshape(-1)
    curvature = 2 * (flat @ (model.hessian @ flat) - (model.coupling @ flat) @ coupled)
    assert curvature == pytest.approx((plus - 2 * left.cost + minus) / h**2, rel=1e-3, abs=1e-3 * left.cost)


def test_the_full_objective_is_g2o_chi2_by_hand():
    turn, shift = 0.3, np.array([0.1, -0.2, 0.4])
    information = np.diag([1.0, 2, 3, 4, 5, 6])[None]
    graph = ViewGraph.from_edges(np.arange(2), np.array([[0, 1]]), np.eye(4)[None], information)
    problem = prepare(graph).problem
    poses = np.stack([np.eye(4), se3.from_parts(se3.so3_exp(np.array([0, 0, turn])), shift)])[problem.order]
    left = full_residuals(problem, information, poses[:, :3, :3], poses[:, :3, 3])
    expected = 3 * (2 * np.sin(turn / 2)) ** 2 + np.array([4, 5, 6]) @ shift**2
    assert left.cost_per_edge[0] == pytest.approx(expected)


def test_the_full_objective_ends_below_every_neighbour():
    graph, _ = ladder(0.3, 3)
    rng = np.random.default_rng(0)
    root = rng.normal(size=(graph.edge_count, 6, 6))
    graph = dataclasses.replace(graph, information=root @ np.swapaxes(root, 1, 2))
    solution = solve(graph)
    for xi in 1e-4 * rng.normal(size=(20, graph.vertex_count, 6)):
        nearby = solve(graph, start=solution.world_from_cam @ se3.exp(xi), initial="given", max_iterations=1)
        assert nearby.metrics["objective"] >= solution.metrics["objective"] * (1 - 1e-9)
    again = solve(graph, start=solution.world_from_cam, initial="given")
    assert again.metrics["objective"] == pytest.approx(solution.metrics["objective"], rel=1e-9)


def test_the_full_descent_begins_at_given_poses_that_are_near_its_minimum(monkeypatch):
    graph, _ = ladder(0.3, rungs=40)
    best, made, isotropic = solve(graph), [], minimise.descend_isotropic
    monkeypatch.setattr(minimise, "descend_isotropic", lambda *some: made.append(1) or isotropic(*some))
    drawn = np.random.default_rng(0).normal(size=(graph.vertex_count, 6))
    near, far = best.world_from_cam @ se3.exp(0.02 * drawn), se3.exp(drawn * np.repeat([1.0, 5.0], 3))
    for start, from_isotropic in ((best.world_from_cam, False), (near, False), (far, True)):
        made.clear()
        found = solve(graph, start=start, initial="given")
        assert found.metrics["objective"] == pytest.approx(best.metrics["objective"], rel=1e-6)
        assert bool(made) == from_isotropic


def test_a_planar_graph_is_solved_in_the_plane():
    graph, _ = ladder(0.2, planar=True)
    poses = solve(graph).world_from_cam
    np.testing.assert_array_equal(poses[:, 2], np.broadcast_to([0, 0, 1, 0], (len(poses), 4)))


def test_joint_steps_lead_where_cg_leads(monkeypatch):
    graph, _ = ladder(0.3, rungs=40)
    best = solve(graph, objective="isotropic", keep_history=True)
    assert all(later.objective <= one.objective for one, later in itertools.pairwise(best.history))
    made, joint_of = [], minimise.JointObjective.of
    monkeypatch.setattr(minimise.JointObjective, "of", lambda problem: made.append(1) or joint_of(problem))
    monkeypatch.setattr(minimise, "CG_FIRST_TO", 0)
    joint = solve(graph, objective="isotropic")
    assert made and joint.metrics["objective"] == pytest.approx(best.metrics["objective"], rel=1e-8)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10**6), size=st.sampled_from([2, 3]))
def test_projection_gives_the_nearest_rotation(seed, size):
    rng = np.random.default_rng(seed)
    matrices = rng.normal(size=(50, size, size)) * 10.0 ** rng.uniform(-6, 6, (50, 1, 1))
    u, _, vt = np.linalg.svd(matrices)
    u[:, :, -1] *= np.sign(np.linalg.det(u @ vt))[:, None]
    np.testing.assert_allclose(project(matrices), u @ vt, atol=1e-7)


def test_a_warm_start_that_takes_long_leaves_steps_for_the_objective_asked_for(data_dir):
    graph = as_sesync_reads_it(data_dir, "sphere2500")
    far = se3.exp(np.random.default_rng(0).normal(size=(graph.vertex_count, 6)) * np.repeat([2.0, 50.0], 3))
    found = solve(graph, start=far, initial="given", max_iterations=6)
    assert found.stopped_by == "iteration limit reached" and found.metrics["iterations"] == 3
