"""Rings that close but for half a turn: poses that leave it to one edge are a saddle, from which nothing pulls."""

import dataclasses

import numpy as np
import pytest

from hodge_pipeline import se3
from hodge_pipeline.solvers.maximum_likelihood import solve
from hodge_pipeline.solvers.minimise import turned_back
from hodge_pipeline.solvers.setup import prepare
from hodge_pipeline.types import ViewGraph


def ring(count: int, axis: tuple[float, float, float], at: int, step_m: float = 0.0) -> ViewGraph:
    """0—1—…—0 of equal steps along x, edge `at` turned by half a turn about an axis."""
    k = np.arange(count)
    motion = np.tile(np.eye(4), (count, 1, 1))
    motion[at, :3, :3] = se3.so3_exp(np.pi * np.array([axis]) / np.linalg.norm(axis))[0]
    motion[:, 0, 3] = step_m
    return ViewGraph.from_edges(k, np.stack([k, (k + 1) % count], axis=1), motion)


@pytest.mark.parametrize("initial", ["chordal", "given"])
@pytest.mark.parametrize("objective", ["full", "isotropic"])
@pytest.mark.parametrize("axis", [(1, 0, 0), (0, 0, 1), (1, 2, 3)])
@pytest.mark.parametrize("count", [3, 4, 7, 12, 33])
def test_half_a_turn_is_shared_out_over_the_ring(count, axis, objective, initial):
    """Each edge takes π / n, at a cost of 4 sin²(π / 2n): 0.818 of 12 edges, where the saddle costs 4."""
    least = 4 * count * np.sin(np.pi / (2 * count)) ** 2
    start = np.tile(np.eye(4), (count, 1, 1))
    off = 1e-9 * np.random.default_rng(count).normal(size=(count, 6))
    for at in (0, count // 2, count - 1):
        exact = ring(count, axis, at)
        for graph in (exact, dataclasses.replace(exact, i_from_j=exact.i_from_j @ se3.exp(off))):
            solution = solve(graph, start=start, objective=objective, initial=initial)
            assert solution.converged
            assert solution.metrics["objective"] == pytest.approx(least, rel=1e-6)


@pytest.mark.parametrize("objective", ["full", "isotropic"])
@pytest.mark.parametrize("count", [5, 13])
def test_rings_of_steps_bend_with_it(count, objective):
    """As low as from any of ten random starts, where the saddle costs 4.2 and 4.08."""
    graph = ring(count, (0, 0, 1), count - 1, 1.0)
    rng = np.random.default_rng(0)
    starts = [se3.exp(rng.normal(size=(count, 6))) for _ in range(10)]
    least = min(solve(graph, start=s, initial="given", objective=objective).metrics["objective"] for s in starts)
    assert least < 3.4
    assert solve(graph, objective=objective).metrics["objective"] == pytest.approx(least, rel=1e-6)


def test_an_edge_that_the_others_overrule_stays_half_a_turn_off():
    """Of five parallel edges one is wrong: the poses of the four are a minimum, and no saddle."""
    motion = np.tile(np.eye(4), (5, 1, 1))
    motion[2, :3, :3] = np.diag([-1.0, -1, 1])
    graph = ViewGraph.from_edges(np.arange(2), np.tile([0, 1], (5, 1)), motion)
    setup = prepare(graph, np.tile(np.eye(4), (2, 1, 1)))
    assert turned_back(setup.problem, *setup.initial("given")) is None
    assert solve(graph).metrics["objective"] == pytest.approx(4)
