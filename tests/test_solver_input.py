"""Graphs as they should not be: the solver gives a result with a warning, or one clear line."""

import dataclasses
import itertools

import numpy as np
import pytest

from hodge_pipeline import registry, se3
from hodge_pipeline.complex.components import connected_components
from hodge_pipeline.diagnosis.diagnosis import diagnose
from hodge_pipeline.diagnosis.robust import RobustSolver, solve_robust
from hodge_pipeline.errors import GraphError
from hodge_pipeline.solvers.covariance import marginal_covariances
from hodge_pipeline.solvers.editing import GraphEditor
from hodge_pipeline.solvers.maximum_likelihood import MaximumLikelihoodSolver, solve
from hodge_pipeline.types import Priors, ViewGraph
from solver_graphs import ladder


def test_repeated_edges_count_each_time():
    graph, _ = ladder(0.1)
    twice = graph.select(np.repeat(np.arange(graph.edge_count), 2))
    double = dataclasses.replace(graph, information=2 * graph.information)
    one, two = solve(twice), solve(double)
    assert one.metrics["objective"] == pytest.approx(two.metrics["objective"], rel=1e-9)


@pytest.mark.parametrize("solver", [solve, solve_robust])
def test_weights_that_rounding_cannot_resolve_give_a_warning(solver):
    graph, _ = ladder(0.1)
    for precision, warned in ((1e12, False), (1e30, True)):
        information = np.tile(np.diag([1e2] * 3 + [precision] * 3), (graph.edge_count, 1, 1))
        notes = solver(dataclasses.replace(graph, information=information)).notes
        assert sum("rounding hides the smaller" in note for note in notes) == warned


@pytest.mark.parametrize("objective", ["isotropic", "full"])
@pytest.mark.parametrize("length", [2e7, 1e9, 1e12])
def test_an_edge_longer_than_the_earth_gives_a_result_and_a_warning(objective, length):
    graph, truth = ladder(0.0)
    assert not any("longer than the earth" in note for note in solve(graph, objective=objective).notes)
    motion = graph.i_from_j.copy()
    motion[3, :3, 3] += [length, 0, 0]
    solution = solve(dataclasses.replace(graph, i_from_j=motion), objective=objective)
    i, j = graph.vertex_ids[graph.edges[3]]
    assert any(note.startswith("1 edge is longer than the earth") and f"({i}, {j})" in note for note in solution.notes)
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


@pytest.mark.parametrize("objective", ["isotropic", "full"])
@pytest.mark.parametrize("length", [1e7, 1e9, 1e15])
def test_an_edge_that_contradicts_all_others_is_solved_or_the_result_says_that_it_is_not(objective, length):
    graph, truth = ladder(0.0)
    motion = graph.i_from_j.copy()
    motion[3, :3, 3] += [length, 0, 0]
    wild = dataclasses.replace(graph, i_from_j=motion)
    solution = solve(wild, objective=objective)
    near_truth = solve(wild, objective=objective, start=truth, initial="given")
    assert solution.metrics["objective"] == pytest.approx(near_truth.metrics["objective"], rel=1e-5)
    said = any("look for a wrong edge" in note for note in solution.notes)
    assert said or solution.converged is True


def test_many_parallel_edges_join_their_vertices():
    edges = np.array([(0, 1)] * 256 + [(1, 2)])
    assert connected_components(edges, 3).tolist() == [0, 0, 0]


def without_usable_edges(what: str) -> ViewGraph:
    if what == "self-loops":
        return ViewGraph.from_edges(np.arange(3), [[1, 1], [2, 2]], np.tile(np.eye(4), (2, 1, 1)))
    if what == "zero information":
        motions = se3.exp(np.random.default_rng(0).normal(size=(3, 6)))
        return ViewGraph.from_edges(np.arange(3), [[0, 1], [1, 2], [2, 0]], motions, np.zeros((3, 6, 6)))
    count = {"one vertex": 1, "isolated vertices": 4}[what]
    return ViewGraph.from_edges(np.arange(count), np.zeros((0, 2)), np.zeros((0, 4, 4)))


@pytest.mark.parametrize("what", ["one vertex", "isolated vertices", "self-loops", "zero information"])
@pytest.mark.parametrize("solver", [MaximumLikelihoodSolver(), RobustSolver()])
def test_without_usable_edges_the_poses_are_as_given_and_a_note_says_so(solver, what):
    graph = without_usable_edges(what)
    start = se3.exp(np.random.default_rng(1).normal(size=(graph.vertex_count, 6)))
    solution = solver.solve(graph, start)
    np.testing.assert_allclose(solution.world_from_cam, start, atol=1e-12)
    assert solution.weights.tolist() == [0] * graph.edge_count
    assert any("every pose is as it was at the start" in note for note in solution.notes)
    assert diagnose(graph).piece.shape == (graph.vertex_count,)


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


@pytest.mark.parametrize(
    ("information", "note"),
    [(np.zeros((6, 6)), "1 edge has no information"), (-np.eye(6), "1 edge has information that is not positive")],
)
def test_information_that_says_nothing_is_ignored_and_said(information, note):
    graph, _ = ladder(0.1)
    wild = np.tile(se3.exp(np.ones(6)), (1, 1, 1))
    more = ViewGraph.from_edges(
        graph.vertex_ids,
        np.concatenate([graph.edges, [[0, 11], [4, 4]]]),
        np.concatenate([graph.i_from_j, wild, wild]),
        np.concatenate([graph.information, information[None], np.eye(6)[None]]),
    )
    solution = solve(more)
    assert solution.metrics["objective"] == pytest.approx(solve(graph).metrics["objective"], rel=1e-9)
    assert solution.weights[-2:].tolist() == [0, 0]
    assert any(told.startswith(note) for told in solution.notes)
    assert any("1 edge joins a vertex to itself" in note for note in solution.notes)


def test_edges_of_rotation_alone_are_solved():
    graph, truth = ladder(0.0)
    information = graph.information.copy()
    information[0, 3:, 3:] = 0
    solution = solve(dataclasses.replace(graph, information=information))
    np.testing.assert_allclose(solution.world_from_cam, truth, atol=1e-6)
    assert any("has no definite information on translation" in note for note in solution.notes)


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


def spoiled(what: str) -> np.ndarray:
    """The ladder's motions with each, or the third, no rigid motion."""
    motion = ladder(0.1)[0].i_from_j.copy()
    if what == "transposed":
        return np.ascontiguousarray(np.swapaxes(motion, 1, 2))
    if what == "mirrored":
        motion[2, :3, 0] *= -1
    elif what == "rigid":
        motion[2, :3, :3] *= 1.1
    else:
        motion[2, 1, 1] = np.inf
    return motion


READERS_OF_MOTIONS = {
    "solve": solve,
    "robust": solve_robust,
    "editor": GraphEditor,
    "covariance": lambda graph: marginal_covariances(graph, ladder(0.1)[1], np.array([3])),
    "diagnosis": diagnose,
    **{
        name: lambda graph, name=name: registry.load("solvers", name)().solve(graph, ladder(0.1)[1])
        for name in registry.names("solvers")
    },
}


@pytest.mark.parametrize("what", ["transposed", "mirrored", "rigid", "finite"])
@pytest.mark.parametrize("reader", READERS_OF_MOTIONS)
def test_motions_that_are_not_rigid_are_refused_with_the_edge(reader, what):
    graph = dataclasses.replace(ladder(0.1)[0], i_from_j=spoiled(what))
    row, count = (0, 16) if what == "transposed" else (2, 1)
    i, j = graph.edges[row]
    edge = rf"edge {row} \(vertices {i}, {j}\)"
    with pytest.raises(GraphError, match=rf"^{edge}: its measurement i_from_j .*{what}.*\({count} such edges\)$"):
        READERS_OF_MOTIONS[reader](graph)


def test_rotations_as_inexact_as_those_of_real_files_are_taken():
    """7-Scenes' poses have determinants down to 0.9995."""
    graph, truth = ladder(0.0)
    motion = graph.i_from_j.copy()
    motion[:, :3, :3] *= 0.9995 ** (1 / 3)
    inexact = dataclasses.replace(graph, i_from_j=motion)
    np.testing.assert_allclose(solve(inexact).world_from_cam, truth, atol=1e-6)
    np.testing.assert_allclose(solve_robust(inexact).world_from_cam, truth, atol=1e-6)


@pytest.mark.parametrize(
    ("matrix", "fault"),
    [(np.diag([-1.0, 1, 1, 1]), "is mirrored"), (se3.exp(np.ones(6)).T, "looks transposed"), (2 * np.eye(4), "rigid")],
)
def test_start_poses_and_priors_that_are_not_rigid_are_refused(matrix, fault):
    graph, truth = ladder(0.1)
    start = truth.copy()
    start[7] = matrix
    with pytest.raises(GraphError, match=f"the start pose of vertex 7 .*{fault}"):
        solve(graph, start=start)
    priors = Priors(np.array([2, 5]), np.stack([np.eye(4), matrix]), np.tile(np.eye(6), (2, 1, 1)))
    with pytest.raises(GraphError, match=rf"prior 1 \(vertex 5\) .*{fault}"):
        solve(graph, priors=priors)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"objective": "ful"}, r"objective 'ful' does not exist: take 'isotropic' or 'full'"),
        ({"initial": "odometry"}, r"initial 'odometry' does not exist: take 'chordal' or 'given'"),
        ({"dimension": 4}, r"dimension 4 does not exist: take 2 or 3 or None"),
        ({"time_limit_s": float("nan")}, "time_limit_s is nan: expected seconds above zero"),
        ({"time_limit_s": -1.0}, "time_limit_s is -1: expected seconds above zero"),
        ({"fixed": [0, 12]}, "fixed names vertex row 12, but the graph has 12 vertices"),
        ({"fixed": [-1]}, "fixed names vertex row -1"),
        ({"fixed": np.ones(12, bool)}, "fixed is a mask"),
    ],
)
def test_options_that_do_not_exist_are_refused(options, message):
    graph, truth = ladder(0.1)
    with pytest.raises(GraphError, match=message):
        solve(graph, start=truth, **options)


def test_robust_options_that_do_not_exist_are_refused():
    with pytest.raises(GraphError, match="objective 'ful' does not exist"):
        solve_robust(ladder(0.1)[0], objective="ful")


def test_fixed_vertices_of_the_graph_must_be_there():
    graph, truth = ladder(0.1)
    priors = Priors(np.array([0]), np.eye(4)[None], np.eye(6)[None])
    for known in (None, priors):
        wrong = dataclasses.replace(graph, fixed=np.array([12]), priors=known)
        for reader in (solve, solve_robust, diagnose):
            with pytest.raises(GraphError, match="fixed names vertex row 12"):
                reader(wrong) if reader is diagnose else reader(wrong, start=truth)


def test_contradictory_edges_still_have_a_minimum():
    edges = np.array(list(itertools.combinations(range(6), 2)) * 3)
    motions = se3.exp(3 * np.random.default_rng(0).normal(size=(len(edges), 6)))
    solution = solve(ViewGraph.from_edges(np.arange(6), edges, motions))
    assert np.isfinite(solution.world_from_cam).all()
    assert se3.is_motion(solution.world_from_cam, 1e-9).all()


def test_shapes_that_are_no_motions_are_one_line() -> None:
    edges, motions = [[0, 1], [1, 2], [2, 0], [2, 0]], np.tile(np.eye(4), (4, 1, 1))
    with pytest.raises(GraphError, match=r"i_from_j has the shape \(4, 3, 4\): expected \(4, 4, 4\)"):
        ViewGraph.from_edges(np.arange(3), edges, motions[:, :3])
    with pytest.raises(GraphError, match=r"information has the shape \(4,\): expected \(4, 6, 6\)"):
        ViewGraph.from_edges(np.arange(3), edges, motions, np.ones(4))


def test_plain_lists_are_taken() -> None:
    graph = ViewGraph.from_edges([5, 6, 9], [[0, 1], [1, 2]], np.tile(np.eye(4), (2, 1, 1)).tolist())
    start = np.tile(np.eye(4, dtype=np.float32), (3, 1, 1)).tolist()
    np.testing.assert_allclose(solve(graph, start=start).world_from_cam, start, atol=1e-12)
