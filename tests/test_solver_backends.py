"""Multigrid gives the minimum that a factorisation gives; a graph gets the one that suits it."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.sparse import bsr_matrix, csr_matrix

from backbone_graphs import drive
from hodge_pipeline import se3
from hodge_pipeline.solvers import backends
from hodge_pipeline.solvers import multigrid as multigrid_module
from hodge_pipeline.solvers.backends import choose, laplacian_factor
from hodge_pipeline.solvers.cg import truncated_cg
from hodge_pipeline.solvers.covariance import marginal_covariances
from hodge_pipeline.solvers.direct import factor_s
from hodge_pipeline.solvers.iterative import IterativeSolver
from hodge_pipeline.solvers.linear import factorise
from hodge_pipeline.solvers.maximum_likelihood import solve
from hodge_pipeline.solvers.multigrid import Coarsening, Modes, aggregates, multigrid
from hodge_pipeline.types import Floats, Ints, ViewGraph
from solver_graphs import laplacian


def tube(count: int, ring: int = 20, sigma: float = 0.05, planar: bool = False) -> ViewGraph:
    """Rings of poses, each joined to the next and to two of the ring above; a spiral where planar."""
    k = np.arange(count)
    angle = 2 * np.pi * k / ring
    radius = 5.0 + (k / ring if planar else 0.0)
    height = np.zeros(count) if planar else k / ring
    position = np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=1)
    poses = se3.from_parts(se3.so3_exp(np.outer(angle, [0, 0, 1])), position)
    edges = np.concatenate([np.stack([k[:-s], k[s:]], axis=1) for s in (1, ring, ring + 1)])
    noise = sigma * np.random.default_rng(0).normal(size=(len(edges), 6))
    if planar:
        noise[:, [0, 1, 5]] = 0.0
    measured = se3.inverse(poses[edges[:, 0]]) @ poses[edges[:, 1]] @ se3.exp(noise)
    information = np.tile(np.diag([0, 0, 1.0, 1, 1, 0] if planar else np.ones(6)) / sigma**2, (len(edges), 1, 1))
    return ViewGraph.from_edges(k, edges, measured, information)


def grid(side: int) -> tuple[Ints, Ints, int]:
    """Edges of a square grid whose last vertex is pinned."""
    k = np.arange(side * side).reshape(side, side)
    tail = np.concatenate([k[:-1].ravel(), k[:, :-1].ravel()])
    head = np.concatenate([k[1:].ravel(), k[:, 1:].ravel()])
    return tail, head, side * side - 1


@pytest.mark.parametrize("planar", [False, True])
@pytest.mark.parametrize("objective", ["isotropic", "full"])
def test_multigrid_reaches_the_same_minimum(objective: str, planar: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    graph = tube(800, planar=planar)
    expected = solve(graph, objective=objective, relative_tolerance=1e-12)  # type: ignore[arg-type]
    monkeypatch.setattr(multigrid_module, "COARSEST", 100)
    monkeypatch.setattr(backends, "ITERATIVE_FROM", 0)
    found = solve(graph, objective=objective, relative_tolerance=1e-12)  # type: ignore[arg-type]
    assert found.metrics["objective"] == pytest.approx(expected.metrics["objective"], rel=1e-9)
    np.testing.assert_allclose(found.world_from_cam, expected.world_from_cam, atol=1e-4)


def test_multigrid_solves_a_laplacian(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(backends, "ITERATIVE_FROM", 0)
    tail, head, count = grid(70)
    weights = np.random.default_rng(0).uniform(0.5, 2.0, len(tail))
    rhs = np.random.default_rng(1).normal(size=(count, 3))
    matrix = laplacian(tail, head, weights, count)
    expected = factorise(matrix).solve(rhs)
    chosen, _ = choose(tail, head, count)
    assert chosen is not None
    found = laplacian_factor(matrix, chosen).solve(rhs)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9 * np.abs(expected).max())


def test_a_tangled_graph_is_factorised_for_its_certificate_and_covariances(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(backends, "ITERATIVE_FROM", 300)
    monkeypatch.setattr(backends, "_multigrid", lambda: pytest.fail("preconditioned"))
    graph = tube(400)
    found = solve(graph, objective="isotropic", certificate=True)
    assert found.certified is True
    assert np.isfinite(marginal_covariances(graph, found.world_from_cam, np.array([200]))).all()


def test_choice_factorises_what_is_small_or_like_a_chain_and_preconditions_what_is_tangled(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(backends, "ITERATIVE_FROM", 1000)
    tail, head, count = grid(40)
    assert choose(tail, head, count)[0] is not None
    assert choose(tail, head, count, direct=True)[0] is None
    assert choose(tail[:500], head[:500], 999)[0] is None
    chain = np.arange(1600)
    chosen, plan = choose(chain[:-1], chain[1:], len(chain) - 1)
    assert chosen is None
    assert np.isfinite(plan.work)


def test_choice_takes_the_scalar_laplacians_of_a_town_though_its_joint_factor_costs_more_than_multigrid() -> None:
    graph = drive(world="town", dimension=3, count=30_000, loops=12_000, wrong=0.0).graph
    tail, head = graph.edges.T
    chosen, plan = choose(tail, head, graph.vertex_count - 1)
    assert chosen is None
    assert factor_s(plan, 6) > backends.SECONDS_A_BLOCK * (plan.size + 2 * len(tail))


def test_choice_does_not_look_for_the_order_of_a_chain_tangled_by_loops_between_any_places() -> None:
    count, rng = 20_000, np.random.default_rng(0)
    steps = np.stack([np.arange(count - 1), np.arange(1, count)], axis=1)
    tail, head = np.concatenate([steps, rng.integers(0, count, (5_000, 2))]).T
    chosen, plan = choose(tail, head, count - 1)
    assert chosen is not None
    assert not np.isfinite(plan.work)


def test_a_cycle_is_symmetric_and_positive_definite() -> None:
    tail, head, count = grid(80)
    matrix = laplacian(tail, head, np.ones(len(tail)), count).tobsr((1, 1))
    hierarchy = multigrid(matrix, Modes(), lambda coarse: factorise(coarse).solve, Coarsening())
    assert hierarchy.levels
    x, y = np.random.default_rng(0).normal(size=(2, count))
    first, second = hierarchy.cycle(matrix, x), hierarchy.cycle(matrix, y)
    assert y @ first == pytest.approx(x @ second, rel=1e-10)
    assert x @ first > 0


def test_multigrid_takes_a_graph_with_vertices_that_nothing_joins() -> None:
    count = 400
    matrix = bsr_matrix((np.full((count, 1, 1), 2.0), np.arange(count), np.arange(count + 1)))
    hierarchy = multigrid(matrix, Modes(), lambda coarse: factorise(coarse).solve, Coarsening())
    np.testing.assert_allclose(hierarchy.cycle(matrix, np.ones(count)), 0.5)


def test_a_rigid_body_s_motion_costs_few_steps_however_long_the_levers() -> None:
    """What multigrid for a scalar Laplacian cannot see."""
    count, width = 8000, 4
    k = np.arange(count)
    positions = np.stack([k // width, k % width, np.zeros(count)], axis=1).astype(float)
    tail = np.concatenate([k[:-1], k[:-width]])
    head = np.concatenate([k[1:], k[width:]])
    matrix = rigid_hessian(positions, tail, head)
    hierarchy = multigrid(matrix, Modes(positions[1:]), lambda coarse: factorise(coarse).solve, Coarsening())
    rhs = np.random.default_rng(0).normal(size=matrix.shape[0])
    found = truncated_cg(lambda x: matrix @ x, lambda r: hierarchy.cycle(matrix, r), rhs, 1e-6, 200)
    assert found.steps < 40


def rigid_hessian(positions: Floats, tail: Ints, head: Ints) -> bsr_matrix:
    """Σ |ω_j − ω_i|² + |v_j − v_i − ω_i x (t_j − t_i)|², vertex 0 pinned."""
    count = len(positions)
    jacobian = np.zeros((len(tail), 6, 2, 6))
    jacobian[:, :, 0], jacobian[:, :, 1] = -np.eye(6), np.eye(6)
    jacobian[:, 3:, 0, :3] = se3.hat(positions[head] - positions[tail])
    both = np.stack([tail, head], axis=1)
    blocks = jacobian.transpose(0, 2, 1, 3).reshape(-1, 6, 6)
    indptr = np.arange(0, 2 * len(tail) + 1, 2)
    matrix = csr_matrix(bsr_matrix((blocks, both.reshape(-1), indptr), shape=(6 * len(tail), 6 * count)))[:, 6:]
    return (matrix.T @ matrix).tobsr((6, 6))


def test_a_preconditioner_that_is_not_definite_ends_cg_and_is_made_anew() -> None:
    matrix = bsr_matrix(np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0]), blocksize=(6, 6))
    gradient = np.arange(1.0, 7.0)
    found = truncated_cg(lambda x: matrix @ x, lambda r: -r, gradient, 1e-9, 50)
    assert found.negative_curvature
    assert not found.x.any()
    solver = IterativeSolver(lambda matrix, modes: lambda matrix, r: r)
    solver.latest = lambda matrix, r: -r
    assert solver.refined(matrix, gradient, 1e-9) is None
    step = solver.solve(matrix, gradient, 1e-9, 0.0, np.zeros((1, 3)))
    np.testing.assert_allclose(matrix @ step.x, -gradient, atol=1e-6)


def test_aggregates_take_every_vertex_once_and_are_connected() -> None:
    tail, head, count = grid(60)
    found = aggregates(laplacian(tail, head, np.ones(len(tail)), count).tobsr((1, 1)))
    assert set(found) == set(range(found.max() + 1))
    assert 4 < count / (found.max() + 1) < 16
