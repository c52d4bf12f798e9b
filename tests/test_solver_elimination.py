"""Block elimination of vertices of low degree: it solves what a dense solve does, whatever the graph."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse import bsr_matrix

from hodge_pipeline.errors import GraphError
from hodge_pipeline.solvers.direct import DirectSolver
from hodge_pipeline.solvers.elimination import FEWEST_IN_ROUND, plan_elimination
from hodge_pipeline.solvers.linear import factorise_blocks, fill_reducing_order


def block_laplacian(plan, tail, head, size, rng):
    """A positive definite block matrix on the graph, its rows in the plan's order."""
    count = plan.size
    place = np.empty(count, np.int64)
    place[plan.order] = np.arange(count)
    dense = np.kron(np.eye(count), 0.1 * np.eye(size))
    for i, j in zip(tail, head, strict=True):
        spread = np.zeros((size, count * size))
        for vertex in (i, j):
            if vertex < count:
                spread[:, place[vertex] * size :][:, :size] += rng.normal(size=(size, size))
        dense += spread.T @ spread
    return dense


@settings(max_examples=100, deadline=None)
@given(st.integers(0, 10_000), st.sampled_from([1, 3, 6]), st.sampled_from(["chain", "ladder", "random", "star"]))
def test_it_solves_what_a_dense_solve_does(seed, size, shape):
    rng = np.random.default_rng(seed)
    count = int(rng.integers(1, 40))
    k = np.arange(count)
    tail, head = {
        "chain": (k[:-1], k[1:]),
        "ladder": (np.r_[k[:-1], k[:-2]], np.r_[k[1:], k[2:]]),
        "random": (rng.integers(0, count + 1, 2 * count), rng.integers(0, count + 1, 2 * count)),
        "star": (np.zeros(count - 1, np.int64), k[1:]),
    }[shape]
    plan = plan_elimination(tail, head, count, fill_reducing_order, fewest=2)
    assert sorted(plan.order) == list(range(count))
    dense = block_laplacian(plan, tail, head, size, rng)
    rhs = rng.normal(size=(count * size, 2))
    matrix = bsr_matrix(dense, blocksize=(size, size))
    factor = factorise_blocks(plan, matrix)
    np.testing.assert_allclose(factor.solve(rhs), np.linalg.solve(dense, rhs), rtol=1e-6, atol=1e-8)
    np.testing.assert_allclose(factor.solve(rhs[:, 0]), factor.solve(rhs)[:, 0], rtol=1e-9, atol=1e-12)


def test_a_chain_leaves_next_to_nothing():
    k = np.arange(10_000)
    plan = plan_elimination(k[:-1], k[1:], len(k), fill_reducing_order)
    assert plan.size - plan.core < 2 * FEWEST_IN_ROUND
    assert plan.fill < 4 * len(k)


def test_a_singular_matrix_is_said_to_be_so():
    k = np.arange(2000)
    plan = plan_elimination(k[:-1], k[1:], len(k), fill_reducing_order)
    with pytest.raises(GraphError, match="singular"):
        factorise_blocks(plan, bsr_matrix((len(k), len(k)), blocksize=(1, 1), dtype=float))


def test_an_old_factor_serves_a_near_hessian_and_a_far_one_gets_its_own():
    rng = np.random.default_rng(0)
    k = np.arange(60)
    plan = plan_elimination(k[:-1], k[1:], len(k), fill_reducing_order)
    first = block_laplacian(plan, k[:-1], k[1:], 3, rng)
    gradient = rng.normal(size=len(first))
    nowhere = np.zeros((len(k), 3))
    direct = DirectSolver(plan)
    direct.solve(bsr_matrix(first, blocksize=(3, 3)), gradient, 1e-3, 0.0, nowhere)
    factor = direct.factor
    near = direct.solve(bsr_matrix(1.01 * first, blocksize=(3, 3)), gradient, 1e-3, 0.0, nowhere)
    assert direct.factor is factor
    np.testing.assert_allclose(near.x, -np.linalg.solve(1.01 * first, gradient), rtol=0.02, atol=0.02)
    far = block_laplacian(plan, k[:-1], k[1:], 3, np.random.default_rng(1))
    found = direct.solve(bsr_matrix(far, blocksize=(3, 3)), gradient, 1e-3, 0.0, nowhere)
    assert direct.factor is not factor
    np.testing.assert_allclose(found.x, -np.linalg.solve(far, gradient), rtol=1e-6, atol=1e-6)
