"""Algorithm 1: rotation systems, cells, genus, triangulation; homology of the surface."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse import vstack

from betti import sparse_rank
from complex_graphs import (
    TRIANGLE,
    complete,
    graphs,
    random_motions,
    torus_grid,
    torus_rotation,
)
from hodge_paper.embedding import Embedding, embed, triangulate
from hodge_paper.homology import homology_generators, motion_deviation
from hodge_paper.rotation import angular_rotation, random_rotation
from hodge_pipeline.complex.coboundary import coboundary_0
from hodge_pipeline.complex.cycles import loop_products
from hodge_pipeline.errors import GraphError
from hodge_pipeline.types import Ints


def random_embedding(graph: tuple[Ints, int], seed: int) -> Embedding:
    return embed(*graph, random_rotation(graph[0], seed))


@given(graph=graphs(), seed=st.integers(0, 1000))
@settings(max_examples=80, deadline=None)
def test_every_half_edge_is_in_one_cell_and_the_euler_characteristic_is_even(
    graph: tuple[Ints, int], seed: int
) -> None:
    edges, count = graph
    embedding = random_embedding(graph, seed)
    darts = 2 * embedding.cells.edge + (embedding.cells.sign < 0)
    np.testing.assert_array_equal(np.sort(darts), np.arange(2 * len(edges)))
    np.testing.assert_array_equal(
        embedding.cell_of_dart[darts], np.repeat(np.arange(len(embedding.cells)), embedding.cells.lengths)
    )
    characteristics = embedding.euler_characteristics
    assert (characteristics % 2 == 0).all()
    assert (characteristics <= 2).all()
    isolated = int((np.bincount(embedding.component[edges[:, 0]], minlength=len(characteristics)) == 0).sum())
    assert count - len(edges) + len(embedding.cells) + isolated == characteristics.sum()


@given(graph=graphs(), seed=st.integers(0, 1000))
@settings(max_examples=80, deadline=None)
def test_cells_are_closed_walks_in_the_rotations_order(graph: tuple[Ints, int], seed: int) -> None:
    edges, count = graph
    rotation = random_rotation(edges, seed)
    embedding = embed(edges, count, rotation)
    source = edges.reshape(-1)
    for first, last in zip(embedding.cells.offsets[:-1], embedding.cells.offsets[1:], strict=True):
        walk = (2 * embedding.cells.edge + (embedding.cells.sign < 0))[first:last]
        assert walk[0] == walk.min()
        for dart, following in zip(walk, np.roll(walk, -1), strict=True):
            around = rotation[source[rotation] == source[dart ^ 1]].tolist()
            assert following == around[(around.index(dart ^ 1) + 1) % len(around)]


@given(graph=graphs(), seed=st.integers(0, 1000))
@settings(max_examples=80, deadline=None)
def test_the_triangulation_keeps_the_surface(graph: tuple[Ints, int], seed: int) -> None:
    edges, count = graph
    embedding = random_embedding(graph, seed)
    surface = triangulate(embedding)
    assert (surface.faces.lengths <= 3).all()
    assert len(surface.edges) - len(edges) == len(surface.faces) - len(embedding.cells)
    assert not (surface.d1 @ coboundary_0(surface.edges, count)).toarray().any()
    sides = 2 * surface.faces.edge + (surface.faces.sign < 0)
    np.testing.assert_array_equal(np.sort(sides), np.arange(2 * len(surface.edges)))
    # each cell's outline is the sum of its faces
    assert sparse_rank(surface.d1.astype(int)) == len(surface.faces) - len(np.unique(embedding.component[edges]))


@given(graph=graphs(), seed=st.integers(0, 1000))
@settings(max_examples=80, deadline=None)
def test_the_generators_are_2g_loops_independent_of_the_faces(graph: tuple[Ints, int], seed: int) -> None:
    edges, count = graph
    embedding = random_embedding(graph, seed)
    loops = homology_generators(embedding)
    assert len(loops) == 2 * embedding.genus
    incidence = loops.incidence(len(edges))
    assert not (incidence @ coboundary_0(edges, count)).toarray().any()
    faces = embedding.cells.incidence(len(edges))
    together = sparse_rank(vstack([faces, incidence]).tocsr().astype(int)) if len(edges) else 0
    assert together == sparse_rank(faces.astype(int)) + 2 * embedding.genus


def test_a_triangle_lies_on_a_sphere_between_two_cells() -> None:
    embedding = embed(TRIANGLE, 3, random_rotation(TRIANGLE, 0))
    assert embedding.cells.lengths.tolist() == [3, 3]
    assert embedding.genus == 0
    assert len(homology_generators(embedding)) == 0


def test_a_grid_on_the_torus_has_square_cells_and_two_generators() -> None:
    embedding = embed(torus_grid(4), 16, torus_rotation(4))
    assert embedding.cells.lengths.tolist() == [4] * 16
    assert embedding.genera.tolist() == [1]
    surface = triangulate(embedding)
    assert len(surface.faces) == 32
    assert len(surface.edges) == 48
    generators = homology_generators(embedding)
    assert len(generators) == 2
    assert generators.lengths.min() == 4


def test_k5_needs_a_handle_and_k4_may_do_without() -> None:
    genera = {embed(complete(5), 5, random_rotation(complete(5), seed)).genus for seed in range(200)}
    assert min(genera) == 1
    assert max(genera) == 3
    assert 0 in {embed(complete(4), 4, random_rotation(complete(4), seed)).genus for seed in range(50)}


def test_the_angular_order_draws_a_plane_graph_without_handles() -> None:
    """A planar grid seen from any side: every inner cell a square, whatever way the normals point at first."""
    side = 6
    row = np.arange(side * side).reshape(side, side)
    edges = np.vstack(
        [np.stack([row[:, :-1].ravel(), row[:, 1:].ravel()], 1), np.stack([row[:-1].ravel(), row[1:].ravel()], 1)]
    )
    plane = np.stack([row.ravel() % side, row.ravel() // side, np.zeros(side * side)], axis=1)
    turn = random_motions(3, 1)[0, :3, :3]
    embedding = embed(edges, side * side, angular_rotation(edges, plane @ turn.T))
    assert embedding.genus == 0
    assert sorted(embedding.cells.lengths.tolist()) == [4] * 25 + [20]
    random = embed(edges, side * side, random_rotation(edges, 0))
    assert random.genus > 0


def test_the_angular_order_survives_coincident_positions() -> None:
    edges = complete(5)
    assert embed(edges, 5, angular_rotation(edges, np.zeros((5, 3)))).genus >= 1


def test_degenerate_graphs() -> None:
    """A lone edge is a digon; a self-loop lies between two monogons; an isolated vertex is a sphere."""
    lone = embed(np.array([[0, 1]]), 3, np.array([0, 1]))
    assert lone.cells.lengths.tolist() == [2]
    assert lone.genera.tolist() == [0, 0]
    assert not triangulate(lone).d1.toarray().any()
    loop = embed(np.array([[0, 0]]), 1, np.array([0, 1]))
    assert loop.cells.lengths.tolist() == [1, 1]
    assert loop.genera.tolist() == [0]
    twin = embed(np.array([[0, 1], [0, 1]]), 2, np.array([0, 2, 1, 3]))
    assert twin.cells.lengths.tolist() == [2, 2]
    empty = embed(np.zeros((0, 2), int), 2, np.zeros(0, int))
    assert empty.genera.tolist() == [0, 0]
    assert len(triangulate(empty).faces) == 0
    # the commutator of two self-loops: a torus with a single cell
    torus = embed(np.array([[0, 0], [0, 0]]), 1, np.array([0, 2, 1, 3]))
    assert torus.genera.tolist() == [1]
    assert torus.cells.lengths.tolist() == [4]
    assert len(homology_generators(torus)) == 2


def test_a_rotation_system_that_is_none_is_refused() -> None:
    with pytest.raises(GraphError, match="exactly once"):
        embed(TRIANGLE, 3, np.array([0, 0, 1, 2, 3, 4]))
    with pytest.raises(GraphError, match="vertex 0 first"):
        embed(TRIANGLE, 3, np.array([1, 0, 2, 3, 4, 5]))


def test_motions_around_generators_are_measured_apart() -> None:
    edges = torus_grid(3)
    motions = np.broadcast_to(np.eye(4), (18, 4, 4)).copy()
    motions[:, 0, 3] = 0.1
    loops = homology_generators(embed(edges, 9, torus_rotation(3)))
    translation, rotation = motion_deviation(loop_products(loops, motions))
    np.testing.assert_allclose(np.sort(translation), [0.3, 0.3])
    np.testing.assert_allclose(rotation, 0.0)
