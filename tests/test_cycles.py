"""Spanning forests, cycle bases and the motions around loops."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from betti import sparse_rank
from complex_graphs import FIGURE_EIGHT, SQUARE, TRIANGLE, complete, graphs, random_motions, torus_grid
from hodge_paper.minimum_cycles import minimum_cycle_basis
from hodge_pipeline import se3
from hodge_pipeline.complex.coboundary import coboundary_0
from hodge_pipeline.complex.components import connected_components, describe_components
from hodge_pipeline.complex.cycles import (
    adjusted_edges,
    fundamental_loops,
    fundamental_products,
    loop_deviation,
    loop_products,
    spanning_forest,
)
from hodge_pipeline.errors import GraphError
from hodge_pipeline.types import Floats, Ints


def consistent(edges: Ints, poses: Floats) -> Floats:
    return se3.inverse(poses[edges[:, 0]]) @ poses[edges[:, 1]]


@given(graph=graphs())
@settings(max_examples=60, deadline=None)
def test_the_fundamental_loops_are_closed_walks_and_a_basis(graph: tuple[Ints, int]) -> None:
    edges, count = graph
    pieces = int(connected_components(edges, count).max()) + 1
    loops = fundamental_loops(spanning_forest(edges, count))
    assert len(loops) == len(edges) - count + pieces
    incidence = loops.incidence(len(edges))
    assert not (incidence @ coboundary_0(edges, count)).toarray().any()
    assert sparse_rank(incidence.astype(int)) == len(loops)
    start = edges[loops.edge, np.where(loops.sign > 0, 0, 1)]
    end = edges[loops.edge, np.where(loops.sign > 0, 1, 0)]
    for cut in (slice(a, b) for a, b in zip(loops.offsets[:-1], loops.offsets[1:], strict=True)):
        np.testing.assert_array_equal(end[cut], np.roll(start[cut], -1))


@given(graph=graphs(), seed=st.integers(0, 1000))
@settings(max_examples=40, deadline=None)
def test_products_along_loops_and_through_the_tree_agree(graph: tuple[Ints, int], seed: int) -> None:
    edges, count = graph
    forest = spanning_forest(edges, count)
    motions = random_motions(seed, len(edges))
    np.testing.assert_allclose(
        fundamental_products(forest, motions), loop_products(fundamental_loops(forest), motions), atol=1e-10
    )


@given(graph=graphs(), seed=st.integers(0, 1000))
@settings(max_examples=40, deadline=None)
def test_consistent_edges_deviate_around_no_loop(graph: tuple[Ints, int], seed: int) -> None:
    edges, count = graph
    loops = fundamental_loops(spanning_forest(edges, count))
    deviation = loop_deviation(loop_products(loops, consistent(edges, random_motions(seed, count))))
    assert deviation.max(initial=0.0) < 1e-10


def test_a_square_of_translations_misses_by_their_sum() -> None:
    motions = np.broadcast_to(np.eye(4), (4, 4, 4)).copy()
    motions[:, :3, 3] = [[1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0.25]]
    loops = fundamental_loops(spanning_forest(SQUARE, 4))
    assert loops.lengths.tolist() == [4]
    np.testing.assert_allclose(loop_deviation(loop_products(loops, motions)), [0.25])


def test_a_loop_through_an_edge_backwards_takes_its_inverse() -> None:
    """Edge (0, 2) of the triangle is passed against its direction."""
    poses = random_motions(4, 3)
    motions = consistent(TRIANGLE, poses)
    motions[2] = motions[2] @ se3.exp(np.array([0, 0, 0, 0, 0, 0.5]))
    loops = fundamental_loops(spanning_forest(TRIANGLE, 3))
    np.testing.assert_allclose(loop_deviation(loop_products(loops, motions)), [0.5], atol=1e-12)


def test_a_long_chain_is_chained_by_doubling() -> None:
    count = 5000
    ring = np.stack([np.arange(count), (np.arange(count) + 1) % count], axis=1)
    motions = np.broadcast_to(se3.exp(np.array([0, 0, 2 * np.pi / count, 1.0, 0, 0])), (count, 4, 4))
    forest = spanning_forest(ring, count)
    assert fundamental_loops(forest).lengths.tolist() == [count]
    assert loop_deviation(fundamental_products(forest, motions)).max() < 1e-8
    assert loop_deviation(loop_products(fundamental_loops(forest), motions)).max() < 1e-8


def test_loops_of_different_lengths_are_multiplied_in_several_batches(monkeypatch: pytest.MonkeyPatch) -> None:
    edges = torus_grid(6)
    motions = random_motions(0, len(edges))
    loops = fundamental_loops(spanning_forest(edges, 36))
    whole = loop_products(loops, motions)
    monkeypatch.setattr("hodge_pipeline.complex.cycles.LARGEST_BATCH", 7)
    np.testing.assert_allclose(loop_products(loops, motions), whole, atol=1e-12)
    np.testing.assert_allclose(loop_products(loops.select(np.array([5, 2])), motions), whole[[5, 2]], atol=1e-12)


@pytest.mark.parametrize(("pairing", "power"), [(False, 2), (True, 1)])
def test_adjusted_edges_close_to_second_order(pairing: bool, power: int) -> None:
    """Halving f divides the deviation by four; the pairing's translations meet rotations no better."""
    poses, rng = random_motions(1, 5), np.random.default_rng(1)
    edges, f = complete(5), rng.normal(size=(5, 6)) * 1e-3
    forest = spanning_forest(edges, 5)

    def deviation(scale: float) -> float:
        adjusted = adjusted_edges(edges, poses, scale * f, pairing)
        return float(loop_deviation(fundamental_products(forest, adjusted)).sum())

    assert deviation(1.0) > 0
    assert deviation(1.0) / deviation(0.5) >= 2**power - 0.1


@given(graph=graphs(most_vertices=7, most_edges=12))
@settings(max_examples=40, deadline=None)
def test_the_minimum_basis_is_a_basis_no_heavier_than_the_fundamental_one(graph: tuple[Ints, int]) -> None:
    edges, count = graph
    fundamental = fundamental_loops(spanning_forest(edges, count))
    least = minimum_cycle_basis(edges, count)
    assert len(least) == len(fundamental)
    assert least.lengths.sum() <= fundamental.lengths.sum()
    assert not (least.incidence(len(edges)) @ coboundary_0(edges, count)).toarray().any()
    assert sparse_rank(least.incidence(len(edges)).astype(int)) == len(least)


def test_minimum_bases_of_named_graphs() -> None:
    assert minimum_cycle_basis(FIGURE_EIGHT, 5).lengths.tolist() == [3, 3]
    assert minimum_cycle_basis(complete(5), 5).lengths.tolist() == [3] * 6
    assert sorted(minimum_cycle_basis(torus_grid(5), 25).lengths.tolist()) == [4] * 24 + [5, 5]


def test_minimum_bases_refuse_what_would_take_too_long() -> None:
    with pytest.raises(GraphError, match="takes too long"):
        minimum_cycle_basis(torus_grid(40), 1600)


def test_components_are_ordered_by_size_and_described() -> None:
    """0---1    2---3---4    5"""  # noqa: D400
    component = connected_components(np.array([[0, 1], [2, 3], [3, 4]]), 6)
    assert component.tolist() == [1, 1, 0, 0, 0, 2]
    (text,) = describe_components(component, np.array(["a", "b", "c", "d", "e", "f"]))
    assert "piece 0: 3 vertices (c … e)" in text
    assert "piece 1: 2 vertices (a … b)" in text
    assert "(f)" in text
    assert describe_components(np.zeros(3, np.int64), np.arange(3)) == ()


def test_an_edge_to_nowhere_is_named() -> None:
    with pytest.raises(GraphError, match="edge 1 joins vertex rows 1 and 3"):
        spanning_forest(np.array([[0, 1], [1, 3]]), 3)
