"""Whether a minimum is the global one: the certificate, its bound, and the way out of a local minimum."""

import numpy as np
import pytest

from hodge_pipeline import se3
from hodge_pipeline.solvers.certificate import Certificate, bounded, certificate_matrix, certify, lower_bound
from hodge_pipeline.solvers.lifted import LiftedObjective, tangent
from hodge_pipeline.solvers.maximum_likelihood import solve
from hodge_pipeline.solvers.objective import best_translations, residuals
from hodge_pipeline.solvers.setup import prepare
from hodge_pipeline.types import Floats, ViewGraph
from solver_graphs import ladder


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
    assert "not certified" in answer.note and answer.smallest_eigenvalue < 0
    unwound = solve(graph, start=start, initial="given", objective="isotropic", certificate=True)
    assert unwound.metrics["objective"] < 1e-12
    assert unwound.certified is True
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


def test_a_lower_bound_holds_for_all_poses_and_is_tight_at_the_best():
    graph, _ = ladder(0.2)
    best = solve(graph, objective="isotropic", certificate=True)
    assert best.certified is True
    problem = prepare(graph).problem
    poses = best.world_from_cam[problem.order]
    noise = se3.so3_exp(0.02 * np.random.default_rng(1).normal(size=(len(poses), 3)))
    for turn, least in ((np.eye(3), 1 - 1e-5), (noise, -np.inf)):
        rotations = turn @ poses[:, :3, :3]
        translations = best_translations(problem, rotations, poses[:, :3, 3])
        cost = residuals(problem, rotations, translations).cost
        lifted = np.concatenate([rotations, np.zeros((len(rotations), 1, 3))], axis=1)
        padded = np.pad(translations, ((0, 0), (0, 1)))
        bound = lower_bound(problem, lifted, padded, cost, np.nan)
        assert least < bound / best.metrics["objective"] < 1 + 1e-9
        pessimistic = lower_bound(problem, lifted, padded, cost, -1e-3 * cost)
        assert pessimistic <= cost * (1 - 1e-3 * 3 * len(poses))


def test_a_bound_close_enough_is_a_certificate():
    answer = Certificate(False, 1e-7, np.inf, 1, "not certified", -0.1)
    assert bounded(answer, 100.0, -np.inf) is answer
    near = bounded(answer, 100.0, 100.0 - 1e-5)
    assert near.optimal
    assert near.gap_bound == pytest.approx(1e-5)
    far = bounded(answer, 100.0, 99.0)
    assert not far.optimal
    assert far.gap_bound == pytest.approx(1.0)
    assert "lower by more than 1" in far.note


def wound_plane(count: int, windings: int) -> tuple[ViewGraph, Floats]:
    """A ring in the plane whose edges say that nothing turns, and poses that wind around it."""
    edges = np.array([(i, (i + 1) % count) for i in range(count)])
    angles = 2 * np.pi * windings * np.arange(count) / count
    start = se3.from_parts(se3.so3_exp(np.outer(angles, [0, 0, 1])), np.zeros(3))
    return ViewGraph.from_edges(np.arange(count), edges, np.tile(np.eye(4), (count, 1, 1))), start


def test_the_lifted_steps_are_the_derivatives_of_the_lifted_objective():
    graph, _ = ladder(0.2)
    problem = prepare(graph).problem
    lifted = LiftedObjective.of(problem)
    rng = np.random.default_rng(3)
    here = lifted.moved(
        lifted.at(np.eye(3, 5)[None].repeat(problem.count, 0), np.zeros((problem.count, 5))),
        rng.normal(0, 0.3, problem.count * 15),
    )
    along = rng.normal(size=problem.count * 15)
    along /= np.linalg.norm(along)
    slope = (lifted.moved(here, 1e-5 * along).cost - lifted.moved(here, -1e-5 * along).cost) / 2e-5
    gradient = 2 * tangent(here.rotations, here.image)
    assert slope == pytest.approx(float(np.vdot(gradient, along)), rel=1e-5)
    step = lifted.step(here, 0.01, 0.0)
    assert lifted.moved(here, step.direction).cost < here.cost
    assert step.slope == pytest.approx(float(np.vdot(gradient, step.direction)), rel=1e-9)


@pytest.mark.parametrize("windings", [1, 2])
def test_pieces_escape_together_each_in_its_own_gauge(windings: int):
    first, wound = wound_plane(15, windings)
    edges = np.concatenate([first.edges, first.edges + 15])
    graph = ViewGraph.from_edges(np.arange(30), edges, np.concatenate([first.i_from_j, first.i_from_j]))
    turned = se3.from_parts(se3.so3_exp(np.array([[0.0, 0.0, 1.0]])), np.ones(3)) @ wound
    found = solve(
        graph, start=np.concatenate([wound, turned]), initial="given", objective="isotropic", certificate=True
    )
    assert found.metrics["objective_at_start"] > 1
    assert found.metrics["objective"] < 1e-9
    assert found.certified is True


def test_where_no_poses_are_certified_the_staircase_finds_better_ones_and_a_bound():
    """Long loops whose turns are off by 0.8 rad: the chordal start lies in a poor valley."""
    rng = np.random.default_rng(0)
    count = 60
    edges = np.array([(i, i + 1) for i in range(count - 1)] + [(i, i + 12) for i in range(0, count - 12, 3)])
    turn = se3.so3_exp(np.outer(rng.normal(0, 0.8, len(edges)), [0, 0, 1]))
    step = np.outer(edges[:, 1] - edges[:, 0], [1.0, 0, 0])
    graph = ViewGraph.from_edges(np.arange(count), edges, se3.from_parts(turn, step))
    plain = solve(graph, objective="isotropic")
    found = solve(graph, objective="isotropic", certificate=True)
    assert found.metrics["objective"] < 0.98 * plain.metrics["objective"]
    assert found.metrics["gap_bound"] < 0.1 * found.metrics["objective"]
