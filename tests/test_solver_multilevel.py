"""The multilevel start: near the minimum on graphs whose chordal relaxation would be dear, exact where edges agree."""

import numpy as np
import pytest

from hodge_pipeline import se3
from hodge_pipeline.solvers import chordal, multilevel
from hodge_pipeline.solvers.elimination import independent_set
from hodge_pipeline.solvers.maximum_likelihood import solve
from hodge_pipeline.solvers.multilevel import RotationGraph, multilevel_rotations
from hodge_pipeline.solvers.setup import prepare
from hodge_pipeline.types import ViewGraph


def lattice(side, dimension=3):
    """A cube of vertices, each joined to its neighbours."""
    k = np.arange(side**dimension).reshape((side,) * dimension)
    pairs = [(k.take(range(side - 1), axis), k.take(range(1, side), axis)) for axis in range(dimension)]
    return np.concatenate([np.stack([a.ravel(), b.ravel()], axis=1) for a, b in pairs])


def planar(angles):
    c, s = np.cos(angles), np.sin(angles)
    return np.stack([c, -s, s, c], axis=1).reshape(-1, 2, 2)


@pytest.mark.parametrize("size", [2, 3])
def test_consistent_edges_give_the_truth(size):
    rng = np.random.default_rng(0)
    edges = lattice(15)
    count = edges.max() + 1
    truth = se3.so3_exp(rng.normal(size=(count, 3))) if size == 3 else planar(rng.normal(size=count))
    turns = np.swapaxes(truth[edges[:, 0]], 1, 2) @ truth[edges[:, 1]]
    graph = RotationGraph(count, edges[:, 0], edges[:, 1], turns, rng.uniform(1, 5, len(edges)))
    found = multilevel_rotations(graph, chordal._chordal_alone)
    relative = found @ np.swapaxes(truth, 1, 2)
    np.testing.assert_allclose(relative, np.broadcast_to(relative[:1], relative.shape), atol=1e-9)


def noisy_lattice(side, sigma):
    rng = np.random.default_rng(1)
    edges = lattice(side)
    count = edges.max() + 1
    truth = se3.exp(np.concatenate([rng.normal(size=(count, 3)), 10 * rng.random((count, 3))], axis=1))
    noise = se3.exp(rng.normal(size=(len(edges), 6)) * sigma)
    measured = se3.inverse(truth[edges[:, 0]]) @ truth[edges[:, 1]] @ noise
    return ViewGraph.from_edges(np.arange(count), edges, measured)


@pytest.mark.parametrize(("sigma", "same"), [(0.05, False), (0.3, True)])
def test_noise_brings_the_chordal_start_back(sigma, same, monkeypatch):
    monkeypatch.setattr(multilevel, "COARSEST", 50)
    monkeypatch.setattr(chordal, "MULTILEVEL_SECONDS_AN_EDGE", 0.0)
    problem = prepare(noisy_lattice(6, sigma)).problem
    pinned = np.eye(3)[None]
    exact, found = chordal.chordal_rotations(problem, pinned), chordal.initial_rotations(problem, pinned)
    assert np.array_equal(exact, found) == same
    np.testing.assert_allclose(found, exact, atol=0.5)


def test_the_minimum_is_that_of_the_chordal_start(monkeypatch):
    graph = noisy_lattice(8, 0.1)
    chordal_start = solve(graph, objective="isotropic")
    monkeypatch.setattr(multilevel, "COARSEST", 50)
    monkeypatch.setattr(chordal, "AFFORDABLE_S", 0.0)
    monkeypatch.setattr(chordal, "MULTILEVEL_SECONDS_AN_EDGE", 0.0)
    other = solve(graph, objective="isotropic")
    assert other.converged is True
    assert other.metrics["objective"] == pytest.approx(chordal_start.metrics["objective"], rel=1e-9)


def test_an_independent_set_is_independent_and_cannot_grow():
    rng = np.random.default_rng(2)
    tail, head = rng.integers(0, 300, (2, 700))
    chosen = independent_set(tail, head, np.ones(300, bool), rng.permutation(300))
    joined = tail != head
    assert not (chosen[tail] & chosen[head])[joined].any()
    near = np.zeros(300, bool)
    near[tail[chosen[head]]] = near[head[chosen[tail]]] = True
    assert (chosen | near).all()
