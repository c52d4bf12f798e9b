"""Whether a minimum is the global one: the certificate, its bound, and the way out of a local minimum."""

import numpy as np
import pytest

from hodge_pipeline import se3
from hodge_pipeline.solvers.certificate import Certificate, bounded, certificate_matrix, certify, lower_bound
from hodge_pipeline.solvers.hodge import solve
from hodge_pipeline.solvers.objective import best_translations, residuals
from hodge_pipeline.solvers.setup import prepare
from hodge_pipeline.types import ViewGraph
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


def test_a_lower_bound_holds_for_all_poses_and_is_tight_at_the_best():
    graph, _ = ladder(0.2)
    best = solve(graph, objective="isotropic", certificate=True)
    assert best.metrics["certified"] == 1
    problem = prepare(graph).problem
    poses = best.world_from_cam[problem.order]
    noise = se3.so3_exp(0.02 * np.random.default_rng(1).normal(size=(len(poses), 3)))
    for turn, least in ((np.eye(3), 1 - 1e-5), (noise, -np.inf)):
        rotations = turn @ poses[:, :3, :3]
        translations = best_translations(problem, rotations, poses[:, :3, 3])
        cost = residuals(problem, rotations, translations).cost
        lifted = np.concatenate([rotations, np.zeros((len(rotations), 1, 3))], axis=1)
        bound = lower_bound(problem, lifted, np.pad(translations, ((0, 0), (0, 1))), cost)
        assert least < bound / best.metrics["objective"] < 1 + 1e-9


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
