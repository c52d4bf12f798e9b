"""The Čech complex: flag complex, nerve, coboundaries, Betti numbers."""

from __future__ import annotations

from itertools import combinations
from math import comb

import numpy as np
import pytest
from hypothesis import given, settings

from betti import betti_numbers, sparse_rank
from complex_graphs import FIGURE_EIGHT, SQUARE, TRIANGLE, TWO_TRIANGLES, complete, graphs, torus_grid
from hodge_pipeline.complex import cech
from hodge_pipeline.complex.cech import clique_counts, flag_complex, nerve, orient_edges
from hodge_pipeline.complex.coboundary import coboundary_0
from hodge_pipeline.complex.occupancy import voxel_occupancy
from hodge_pipeline.errors import GraphError
from hodge_pipeline.types import CloudSet, Ints, PointCloud


@given(graph=graphs())
@settings(max_examples=60, deadline=None)
def test_the_flag_complex_lists_exactly_the_cliques(graph: tuple[Ints, int]) -> None:
    edges, count = graph
    joined = {(min(a, b), max(a, b)) for a, b in edges.tolist() if a != b}
    complex_ = flag_complex(edges, count)
    for order in range(3):
        cliques = [c for c in combinations(range(count), order + 1) if set(combinations(c, 2)) <= joined]
        assert [tuple(row) for row in complex_.simplices[order].tolist()] == cliques
    assert clique_counts(edges, count) == complex_.counts


@given(graph=graphs())
@settings(max_examples=40, deadline=None)
def test_the_coboundary_of_a_coboundary_is_zero(graph: tuple[Ints, int]) -> None:
    complex_ = flag_complex(*graph)
    d0, d1 = complex_.coboundary(0), complex_.coboundary(1)
    assert not (d1 @ d0).toarray().any()
    assert not (d0 != coboundary_0(complex_.simplices[1], complex_.vertex_count)).toarray().any()


def test_the_signs_are_those_of_equation_1() -> None:
    complex_ = flag_complex(TRIANGLE, 3)
    assert complex_.simplices[1].tolist() == [[0, 1], [0, 2], [1, 2]]
    assert complex_.coboundary(0).toarray().tolist() == [[-1, 1, 0], [-1, 0, 1], [0, -1, 1]]
    assert complex_.coboundary(1).toarray().tolist() == [[1, -1, 1]]


@pytest.mark.parametrize(
    ("edges", "count", "betti"),
    [
        (TRIANGLE, 3, (1, 0)),
        (SQUARE, 4, (1, 1)),
        (TWO_TRIANGLES, 4, (1, 0)),
        (FIGURE_EIGHT, 5, (1, 0)),
        (complete(5), 5, (1, 0)),
        (torus_grid(4), 16, (1, 17)),
        (np.array([[0, 1], [2, 3]]), 5, (3, 0)),
        # the octahedron: every pair but the three opposite ones, a hollow sphere
        (np.array([e for e in combinations(range(6), 2) if sum(e) != 5]), 6, (1, 0)),
    ],
)
def test_betti_numbers_of_named_graphs(edges: Ints, count: int, betti: tuple[int, int]) -> None:
    assert betti_numbers(flag_complex(edges, count)) == betti


@given(graph=graphs())
@settings(max_examples=40, deadline=None)
def test_the_exact_rank_is_the_numerical_one(graph: tuple[Ints, int]) -> None:
    d1 = flag_complex(*graph).coboundary(1)
    expected = int(np.linalg.matrix_rank(d1.toarray())) if d1.shape[0] else 0
    assert sparse_rank(d1) == expected


def test_a_complete_graph_is_counted_before_it_is_listed(monkeypatch: pytest.MonkeyPatch) -> None:
    assert clique_counts(complete(60), 60) == (60, comb(60, 2), comb(60, 3))
    monkeypatch.setattr(cech, "MOST_LISTED", 1000)
    with pytest.raises(GraphError, match="more than 1000 triangles"):
        flag_complex(complete(60), 60)


def test_an_edge_that_a_complex_does_not_have_has_no_row() -> None:
    complex_ = flag_complex(SQUARE, 4)
    assert complex_.rows_of(np.array([[0, 3], [0, 2]])).tolist() == [1, -1]


def test_parallel_edges_are_pooled_with_their_signs() -> None:
    oriented = orient_edges(np.array([[1, 0], [0, 1], [2, 2], [1, 2]]), 3)
    assert oriented.edges.tolist() == [[0, 1], [1, 2]]
    assert oriented.row.tolist() == [0, 0, -1, 1]
    omega, weights = oriented.pooled(np.array([[-1.0], [2.0], [9.0], [5.0]]), np.array([3.0, 1.0, 1.0, 2.0]))
    np.testing.assert_allclose(omega, [[1.25], [5.0]])
    np.testing.assert_allclose(weights, [4.0, 2.0])


def test_the_nerve_drops_a_triangle_whose_clouds_never_meet() -> None:
    """Three clouds that overlap pairwise at the corners; a fourth covers them all."""
    corners = np.array([[0.5, 0.5, 0.5], [1.5, 0.5, 0.5], [2.5, 0.5, 0.5]], np.float32)
    clouds = CloudSet.from_clouds(
        [PointCloud(corners[[a, b]]) for a, b in ((0, 1), (1, 2), (0, 2))] + [PointCloud(corners)]
    )
    poses = np.broadcast_to(np.eye(4), (4, 4, 4)).copy()
    flag = flag_complex(complete(4), 4)
    kept = nerve(flag, voxel_occupancy(clouds, poses, 1.0)[0])
    assert kept.simplices[2].tolist() == [[0, 1, 3], [0, 2, 3], [1, 2, 3]]
    assert kept.counts == (4, 6, 3)
    assert not (kept.coboundary(1) @ kept.coboundary(0)).toarray().any()


def test_voxels_are_those_of_the_world() -> None:
    cloud = PointCloud(np.array([[0.2, 0.2, 0.2]], np.float32))
    poses = np.broadcast_to(np.eye(4), (3, 4, 4)).copy()
    poses[1, 0, 3], poses[2, 0, 3] = 0.5, 3.0
    occupancy, sizes = voxel_occupancy(CloudSet.from_clouds([cloud, cloud, cloud]), poses, 1.0)
    np.testing.assert_array_equal(occupancy.toarray()[:, :2], [[1, 0], [1, 0], [0, 1]])
    assert sizes.tolist() == [1, 1, 1] and occupancy.nnz == 3
