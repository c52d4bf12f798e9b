import dataclasses
import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hodge_adapters.g2o import information_for_file, load_g2o
from hodge_pipeline import se3
from hodge_pipeline.complex.components import connected_components
from hodge_pipeline.errors import GraphError
from hodge_pipeline.solvers import direct, minimise
from hodge_pipeline.solvers.certificate import certificate_matrix, certify
from hodge_pipeline.solvers.full import full_residuals
from hodge_pipeline.solvers.hodge import HodgeSolver, solve
from hodge_pipeline.solvers.objective import best_translations, quadratic_model, residuals, rotation_gradient
from hodge_pipeline.solvers.rotations import exponential, project
from hodge_pipeline.solvers.setup import prepare
from hodge_pipeline.stages import ConsistencySolver
from hodge_pipeline.types import Priors, ViewGraph

CERTIFIED_OPTIMA = {
    "smallGrid3D": 1025.39806,
    "parking-garage": 1.26252443,
    "sphere2500": 1687.005814,
    "torus3D": 24227.04556,
    "cubicle": 717.125991,
    "MIT": 61.1541155,
    "CSAIL": 31.7037159,
    "intel": 52.3482273,
    "manhattan": 6431.391387,
    "kitti_00": 125.693515,
    "kitti_05": 276.514377,
}
PLANAR_OUTSIDE = [0, 1, 5]


def ladder(noise: float, seed: int = 0, rungs: int = 6, planar: bool = False) -> tuple[ViewGraph, np.ndarray]:
    """0—2—4—…
    |  |  |     two rails, a rung at each step, and its true poses.
    1—3—5—…
    """
    rng = np.random.default_rng(seed)
    twists = rng.normal(size=(2 * rungs, 6))
    rail = [(i, i + 2) for i in range(2 * rungs - 2)]
    edges = np.array(rail + [(2 * i, 2 * i + 1) for i in range(rungs)])
    errors = noise * rng.normal(size=(len(edges), 6))
    information = np.tile(np.diag([4.0, 4, 4, 1, 1, 1]), (len(edges), 1, 1))
    if planar:
        for array in (twists, errors):
            array[:, PLANAR_OUTSIDE] = 0
        information[:, PLANAR_OUTSIDE] = 0
    truth = se3.exp(twists)
    truth = se3.inverse(truth[:1]) @ truth
    measured = se3.inverse(truth[edges[:, 0]]) @ truth[edges[:, 1]] @ se3.exp(errors)
    return ViewGraph.from_edges(np.arange(2 * rungs), edges, measured, information), truth


def as_sesync_reads_it(data_dir, name):
    file = load_g2o(data_dir / "pose_graphs" / "sesync" / f"{name}.g2o")
    if file.graph.dimension == 2:
        return file.graph
    return dataclasses.replace(
        file.graph, information=np.roll(information_for_file(file.graph.information), (3, 3), axis=(1, 2))
    )


@pytest.mark.parametrize("name", CERTIFIED_OPTIMA)
def test_certified_optima_of_the_literature_are_reached(data_dir, name):
    solution = solve(as_sesync_reads_it(data_dir, name), objective="isotropic", certificate=True)
    assert solution.metrics["objective"] == pytest.approx(CERTIFIED_OPTIMA[name], rel=1e-8)
    assert solution.metrics["converged"] == 1
    assert solution.metrics["certified"] == 1


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


def test_a_planar_graph_is_solved_in_the_plane():
    graph, _ = ladder(0.2, planar=True)
    poses = solve(graph).world_from_cam
    np.testing.assert_array_equal(poses[:, 2], np.broadcast_to([0, 0, 1, 0], (len(poses), 4)))


def test_a_local_minimum_is_not_certified():
    """Every edge of this ring says that the next pose is the same; the start winds once around."""
    count = 12
    angles = 2 * np.pi * np.arange(count) / count
    start = se3.from_parts(se3.so3_exp(np.outer(angles, [0, 0, 1])), np.zeros(3))
    edges = np.array([(i, (i + 1) % count) for i in range(count)])
    graph = ViewGraph.from_edges(np.arange(count), edges, np.tile(np.eye(4), (count, 1, 1)))
    wound = solve(graph, start=start, initial="given", objective="isotropic")
    assert wound.metrics["objective"] > 1
    problem = prepare(graph, start).problem
    poses = wound.world_from_cam[problem.order]
    answer = certify(problem, poses[:, :3, :3], poses[:, :3, 3], wound.metrics["objective"])
    assert not answer.optimal
    assert answer.negative_eigenvalues > 0
    assert "not certified" in answer.note
    unwound = solve(graph, start=start, initial="given", objective="isotropic", certificate=True)
    assert unwound.metrics["objective"] < 1e-12
    assert unwound.metrics["certified"] == 1
    assert any("local minimum" in note for note in unwound.notes)


def test_the_smallest_eigenvalue_of_a_local_minimum_is_that_of_the_dense_matrix():
    count = 12
    angles = 2 * np.pi * np.arange(count) / count
    turned = se3.so3_exp(np.outer(angles, [0, 0, 1]))
    edges = np.array([(i, (i + 1) % count) for i in range(count)])
    graph = ViewGraph.from_edges(np.arange(count), edges, np.tile(np.eye(4), (count, 1, 1)))
    wound = solve(graph, start=se3.from_parts(turned, np.zeros(3)), initial="given", objective="isotropic")
    problem = prepare(graph).problem
    poses = wound.world_from_cam[problem.order]
    answer = certify(problem, poses[:, :3, :3], poses[:, :3, 3], wound.metrics["objective"])
    dense = certificate_matrix(problem, poses[:, :3, :3], poses[:, :3, 3]).toarray().reshape(count, 4, count, 4)
    rotation = dense[:, :3, :, :3].reshape(3 * count, 3 * count)
    coupling = dense[:, :3, :, 3].reshape(3 * count, count)
    complement = rotation - coupling @ np.linalg.pinv(dense[:, 3, :, 3]) @ coupling.T
    assert answer.smallest_eigenvalue == pytest.approx(np.linalg.eigvalsh(complement)[0], rel=1e-3)
    assert answer.direction.shape == (count, 3)


def test_components_keep_their_own_gauge():
    graph, truth = ladder(0.0)
    apart = dataclasses.replace(
        ViewGraph.from_edges(
            np.arange(25),
            np.concatenate([graph.edges, graph.edges + 12]),
            np.concatenate([graph.i_from_j] * 2),
            np.concatenate([graph.information] * 2),
        )
    )
    far = se3.exp(np.array([0.1, 0.2, 0.3, 50, 0, 0]))
    start = np.concatenate([truth, far @ truth, far[None]])
    start[1:12] = start[13:24] = np.eye(4)
    solution = solve(apart, start=start)
    np.testing.assert_allclose(solution.world_from_cam[:12], truth, atol=1e-6)
    np.testing.assert_allclose(solution.world_from_cam[12:24], far @ truth, atol=1e-6)
    np.testing.assert_array_equal(solution.world_from_cam[24], far)
    assert solution.component.tolist() == [0] * 12 + [1] * 12 + [2]
    assert any("3 pieces" in note for note in solution.notes)


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
    assert one.metrics["converged"] == 0
    assert best.metrics["objective"] < one.metrics["objective"]
    late = solve(graph, time_limit_s=1e-9, objective="isotropic")
    assert any("time limit reached" in note for note in late.notes)


def test_repeated_edges_count_each_time():
    graph, _ = ladder(0.1)
    twice = graph.select(np.repeat(np.arange(graph.edge_count), 2))
    double = dataclasses.replace(graph, information=2 * graph.information)
    one, two = solve(twice), solve(double)
    assert one.metrics["objective"] == pytest.approx(two.metrics["objective"], rel=1e-9)


@pytest.mark.parametrize("objective", ["isotropic", "full"])
@pytest.mark.parametrize("length", [2e7, 1e9, 1e12])
def test_an_edge_longer_than_the_earth_gives_a_result_and_a_warning(objective, length):
    graph, truth = ladder(0.0)
    assert not any("longer than the earth" in note for note in solve(graph, objective=objective).notes)
    motion = graph.i_from_j.copy()
    motion[3, :3, 3] += [length, 0, 0]
    solution = solve(dataclasses.replace(graph, i_from_j=motion), objective=objective)
    i, j = graph.vertex_ids[graph.edges[3]]
    assert any(
        note.startswith("1 edges are longer than the earth") and f"({i}, {j})" in note for note in solution.notes
    )
    assert np.isfinite(solution.world_from_cam).all()
    left = motion - se3.inverse(truth[graph.edges[:, 0]]) @ truth[graph.edges[:, 1]]
    assert solution.metrics["objective"] < (left[3, :3, 3] @ left[3, :3, 3]) * (1 + 1e-9)


@pytest.mark.parametrize("objective", ["isotropic", "full"])
def test_two_halves_farther_apart_than_the_earth_is_wide(objective):
    graph, truth = ladder(0.0)
    far = truth.copy()
    far[6:, 0, 3] += 2e7
    apart = dataclasses.replace(graph, i_from_j=se3.inverse(far[graph.edges[:, 0]]) @ far[graph.edges[:, 1]])
    np.testing.assert_allclose(solve(apart, objective=objective).world_from_cam, far, rtol=1e-9, atol=1e-6)


def test_direct_steps_take_over_where_cg_takes_long(monkeypatch):
    graph, _ = ladder(0.3, rungs=40)
    best = solve(graph, objective="isotropic")
    assert minimise.steps_are_direct(prepare(graph).problem)
    made, joint_of = [], minimise.JointObjective.of
    monkeypatch.setattr(minimise.JointObjective, "of", lambda problem: made.append(1) or joint_of(problem))
    monkeypatch.setattr(minimise, "CG_STEPS_BEFORE_DIRECT", 1)
    taken_over = solve(graph, objective="isotropic", keep_history=True)
    assert taken_over.metrics["objective"] == pytest.approx(best.metrics["objective"], rel=1e-8)
    assert taken_over.metrics["iterations"] == len(taken_over.history)
    assert all(later.objective <= one.objective for one, later in itertools.pairwise(taken_over.history))
    monkeypatch.setattr(direct, "CG_FIRST_TO", 0)
    at_once = solve(graph, objective="isotropic")
    assert len(made) == 2
    assert at_once.metrics["objective"] == pytest.approx(best.metrics["objective"], rel=1e-8)


def test_many_parallel_edges_join_their_vertices():
    edges = np.array([(0, 1)] * 256 + [(1, 2)])
    assert connected_components(edges, 3).tolist() == [0, 0, 0]


def test_no_edges_and_one_pose():
    for count in (1, 3):
        graph = ViewGraph.from_edges(np.arange(count), np.zeros((0, 2)), np.zeros((0, 4, 4)))
        start = np.tile(se3.exp(np.arange(6.0)), (count, 1, 1))
        solution = HodgeSolver().solve(graph, start)
        np.testing.assert_allclose(solution.world_from_cam, start, atol=1e-12)
        assert solution.metrics["objective"] == 0


@pytest.mark.parametrize("scale", [1e-9, 1e-4, 1e4, 1e9])
def test_scales_do_not_matter(scale):
    graph, _ = ladder(0.1)
    reference = solve(graph)
    motion = graph.i_from_j.copy()
    motion[:, :3, 3] *= scale
    information = graph.information.copy()
    information[:, 3:, 3:] /= scale**2
    solution = solve(dataclasses.replace(graph, i_from_j=motion, information=information))
    assert solution.metrics["objective"] == pytest.approx(reference.metrics["objective"], rel=1e-7)
    heavy = solve(dataclasses.replace(graph, information=scale * graph.information))
    assert heavy.metrics["objective"] == pytest.approx(scale * reference.metrics["objective"], rel=1e-7)


def test_zero_information_is_ignored_and_said():
    graph, _ = ladder(0.1)
    wild = np.tile(se3.exp(np.ones(6)), (1, 1, 1))
    more = ViewGraph.from_edges(
        graph.vertex_ids,
        np.concatenate([graph.edges, [[0, 11], [4, 4]]]),
        np.concatenate([graph.i_from_j, wild, wild]),
        np.concatenate([graph.information, np.zeros((1, 6, 6)), np.eye(6)[None]]),
    )
    solution = solve(more)
    assert solution.metrics["objective"] == pytest.approx(solve(graph).metrics["objective"], rel=1e-9)
    assert solution.weights[-2:].tolist() == [0, 0]
    assert any("1 edges have no information" in note for note in solution.notes)
    assert any("1 edges join a vertex to itself" in note for note in solution.notes)


def test_edges_of_rotation_alone_are_solved():
    graph, truth = ladder(0.0)
    information = graph.information.copy()
    information[0, 3:, 3:] = 0
    solution = solve(dataclasses.replace(graph, information=information))
    np.testing.assert_allclose(solution.world_from_cam, truth, atol=1e-6)
    assert any("say nothing definite on translation" in note for note in solution.notes)


def test_indefinite_information_falls_back_and_says_so():
    graph, _ = ladder(0.1)
    information = graph.information.copy()
    information[3, 0, 3] = information[3, 3, 0] = 10.0
    graph = dataclasses.replace(graph, information=information)
    solution = solve(graph)
    assert any("1 of 16 information matrices are indefinite" in note for note in solution.notes)
    assert solution.metrics["isotropic"] == pytest.approx(solve(graph, objective="isotropic").metrics["objective"])


def spoil(what: str) -> ViewGraph:
    graph, _ = ladder(0.1)
    motion, information, edges = graph.i_from_j.copy(), graph.information.copy(), graph.edges.copy()
    if what == "measurement":
        motion[2, 0, 3] = np.nan
    elif what == "information":
        information[2, 0, 0] = np.inf
    else:
        edges[2, 1] = 99
    return dataclasses.replace(graph, i_from_j=motion, information=information, edges=edges)


@pytest.mark.parametrize("what", ["measurement", "information", "vertex"])
def test_numbers_that_cannot_be_used_are_named(what):
    with pytest.raises(GraphError, match=f"edge 2.*{what}"):
        solve(spoil(what))


def test_contradictory_edges_still_have_a_minimum():
    edges = np.array(list(itertools.combinations(range(6), 2)) * 3)
    motions = se3.exp(3 * np.random.default_rng(0).normal(size=(len(edges), 6)))
    solution = solve(ViewGraph.from_edges(np.arange(6), edges, motions))
    assert np.isfinite(solution.world_from_cam).all()
    assert se3.is_motion(solution.world_from_cam, 1e-9).all()


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10**6), size=st.sampled_from([2, 3]))
def test_projection_gives_the_nearest_rotation(seed, size):
    rng = np.random.default_rng(seed)
    matrices = rng.normal(size=(50, size, size)) * 10.0 ** rng.uniform(-6, 6, (50, 1, 1))
    u, _, vt = np.linalg.svd(matrices)
    u[:, :, -1] *= np.sign(np.linalg.det(u @ vt))[:, None]
    np.testing.assert_allclose(project(matrices), u @ vt, atol=1e-7)


def test_the_stage_keeps_its_protocol_and_history():
    graph, truth = ladder(0.1)
    stage = HodgeSolver()
    assert isinstance(stage, ConsistencySolver)
    solution = stage.solve(graph, truth)
    np.testing.assert_allclose(solution.world_from_cam[0], truth[0], atol=1e-12)
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
    with pytest.raises(GraphError, match="prior 1 names vertex row 7"):
        solve(graph, priors=Priors(np.array([0, 7]), known, priors.information))


def test_priors_join_pieces_and_can_be_certified():
    graph, truth = ladder(0.0)
    half = graph.select(np.flatnonzero((graph.edges < 6).all(axis=1) | (graph.edges >= 6).all(axis=1)))
    priors = Priors(np.array([0, 7]), truth[[0, 7]], np.tile(np.eye(6), (2, 1, 1)))
    solution = solve(half, priors=priors, objective="isotropic", certificate=True)
    np.testing.assert_allclose(solution.world_from_cam, truth, atol=1e-6)
    assert solution.component.max() == 0
    assert solution.metrics["certified"] == 1


def test_the_graph_says_what_is_fixed_and_in_which_plane():
    graph, truth = ladder(0.1, planar=True)
    held = dataclasses.replace(graph, fixed=np.array([3, 7]), dimension=2)
    solution = solve(held, start=truth)
    np.testing.assert_allclose(solution.world_from_cam[[3, 7]], truth[[3, 7]], atol=1e-12)
    assert solution.metrics["objective_at_start"] > solution.metrics["objective"]
    assert any("2 fixed vertices have no pose" in note for note in solve(held).notes)
