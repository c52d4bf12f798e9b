"""The Poisson solver: laws on random graphs, hand answers on named little ones, malformed input, real pose graphs."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hodge_paper.minimum_cycles import shortest_loops
from hodge_pipeline import se3
from hodge_pipeline.errors import GraphError
from hodge_pipeline.solvers import poisson
from hodge_pipeline.solvers.poisson import PoissonSolver
from hodge_pipeline.types import Floats, Ints, ViewGraph

PLAIN = PoissonSolver(inner_iterations=12)


def motions(rng: np.random.Generator, count: int, angle: float = 1.0, shift_m: float = 1.0) -> Floats:
    return se3.exp(np.hstack([rng.normal(size=(count, 3)) * angle, rng.normal(size=(count, 3)) * shift_m]))


def ring_with_chords(rng: np.random.Generator, count: int, chords: int) -> Ints:
    ring = np.stack([np.arange(count), (np.arange(count) + 1) % count], axis=1)
    return np.vstack([ring, rng.choice(count, size=(chords, 2))])


def measured(edges: Ints, truth: Floats, rng: np.random.Generator, noise: float = 0.0) -> ViewGraph:
    i, j = edges.T
    exact = se3.inverse(truth[i]) @ truth[j]
    return ViewGraph.from_edges(np.arange(len(truth)), edges, exact @ se3.exp(rng.normal(size=(len(edges), 6)) * noise))


def relative(poses: Floats) -> Floats:
    return se3.inverse(poses[:1]) @ poses


@given(seed=st.integers(0, 10_000), count=st.integers(2, 9))
@settings(max_examples=30, deadline=None)
def test_consistent_edges_give_back_the_truth(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    truth = motions(rng, count)
    start = truth @ se3.exp(rng.normal(size=(count, 6)) * 0.02)
    solution = PLAIN.solve(measured(ring_with_chords(rng, count, 4), truth, rng), start)
    np.testing.assert_allclose(relative(solution.world_from_cam), relative(truth), atol=1e-8)
    np.testing.assert_array_equal(solution.world_from_cam[0], start[0])


@given(seed=st.integers(0, 10_000))
@settings(max_examples=20, deadline=None)
def test_relabelling_flipping_and_shifting_change_nothing(seed: int) -> None:
    rng = np.random.default_rng(seed)
    truth = motions(rng, 7)
    graph = measured(ring_with_chords(rng, 7, 6), truth, rng, noise=0.05)
    start = truth @ se3.exp(rng.normal(size=(7, 6)) * 0.05)
    solver = PoissonSolver()
    expected = relative(solver.solve(graph, start).world_from_cam)

    flip = rng.random(graph.edge_count) < 0.5
    edges, motion = graph.edges.copy(), graph.i_from_j.copy()
    edges[flip], motion[flip] = edges[flip, ::-1], se3.inverse(motion[flip])
    flipped = solver.solve(ViewGraph.from_edges(graph.vertex_ids, edges, motion), start)
    np.testing.assert_allclose(relative(flipped.world_from_cam), expected, atol=1e-9)

    shift = np.eye(4)
    shift[:3, 3] = [200.0, -30.0, 5.0]
    shifted = solver.solve(graph, shift @ start)
    np.testing.assert_allclose(relative(shifted.world_from_cam), expected, atol=1e-9)

    new_row = rng.permutation(7)
    relabelled = ViewGraph.from_edges(graph.vertex_ids, new_row[graph.edges], graph.i_from_j)
    start_of_new = np.empty_like(start)
    start_of_new[new_row] = start
    moved = solver.solve(relabelled, start_of_new).world_from_cam[new_row]
    np.testing.assert_allclose(relative(moved), expected, atol=1e-9)


def test_the_papers_pairing_depends_on_the_direction_of_an_edge() -> None:
    rng = np.random.default_rng(3)
    truth = motions(rng, 6)
    graph = measured(ring_with_chords(rng, 6, 5), truth, rng, noise=0.1)
    flipped = ViewGraph.from_edges(graph.vertex_ids, graph.edges[:, ::-1], se3.inverse(graph.i_from_j))
    solver = PoissonSolver(log="pairing")
    difference = solver.solve(graph, truth).world_from_cam - solver.solve(flipped, truth).world_from_cam
    assert 1e-5 < np.abs(difference).max() < 0.1


def test_a_triangle_shares_its_error_equally() -> None:
    """Three translations that miss closing by 3 cm: each edge gives up 1 cm.

        2
       / \\
      0---1
    """
    edges = np.array([[0, 1], [1, 2], [0, 2]])
    motion = np.broadcast_to(np.eye(4), (3, 4, 4)).copy()
    motion[:, 0, 3] = [1.0, 1.0, 2.03]
    solution = PoissonSolver().solve(
        ViewGraph.from_edges(np.arange(3), edges, motion), np.broadcast_to(np.eye(4), (3, 4, 4)).copy()
    )
    np.testing.assert_allclose(solution.world_from_cam[:, 0, 3], [0.0, 1.01, 2.02], atol=1e-12)
    assert solution.history[-1].objective == pytest.approx(0.5 * 3 * 0.01**2)
    assert solution.metrics["loops"] == 1
    assert solution.metrics["measured_loop_deviation_sum"] == pytest.approx(0.03)


def test_the_loop_deviation_falls_to_nothing_within_three_iterations() -> None:
    rng = np.random.default_rng(1)
    truth = motions(rng, 40, angle=0.5)
    edges = ring_with_chords(rng, 40, 120)
    graph = measured(edges[edges[:, 0] != edges[:, 1]], truth, rng, noise=0.01)
    start = truth @ se3.exp(rng.normal(size=(40, 6)) * 0.03)
    deviation = [it.metrics["loop_deviation_mean"] for it in PoissonSolver().solve(graph, start).history]
    assert deviation[0] > 1e-6
    assert deviation[1] < deviation[0] / 20
    assert deviation[2] < deviation[1] / 20


def test_the_basis_of_loops_changes_what_is_reported_and_not_the_poses(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(4)
    truth = motions(rng, 30, angle=0.5)
    graph = measured(ring_with_chords(rng, 30, 60), truth, rng, noise=0.01)
    start = truth @ se3.exp(rng.normal(size=(30, 6)) * 0.03)
    tree = PoissonSolver().solve(graph, start)
    monkeypatch.setattr(poisson, "tree_loops", shortest_loops)
    shortest = PoissonSolver().solve(graph, start)
    np.testing.assert_array_equal(tree.world_from_cam, shortest.world_from_cam)
    assert tree.metrics["loops"] == shortest.metrics["loops"]
    first = [s.history[0].metrics["loop_deviation_mean"] for s in (tree, shortest)]
    assert 0 < first[1] < first[0]


def test_pieces_and_isolated_vertices_are_named_and_solved_apart() -> None:
    """Vertex 5 is alone; the smaller piece keeps the gauge of its first vertex.

    0---1---2    3---4    5
    """
    rng = np.random.default_rng(2)
    truth = motions(rng, 6)
    edges = np.array([[3, 4], [0, 1], [1, 2]])
    start = truth @ se3.exp(rng.normal(size=(6, 6)) * 0.02)
    solution = PLAIN.solve(measured(edges, truth, rng), start)
    assert solution.component.tolist() == [0, 0, 0, 1, 1, 2]
    for first in (0, 3, 5):
        np.testing.assert_array_equal(solution.world_from_cam[first], start[first])
    np.testing.assert_allclose(relative(solution.world_from_cam[3:5]), relative(truth[3:5]), atol=1e-9)
    (note,) = solution.notes
    assert "3 pieces" in note
    assert "piece 1: 2 vertices (3 … 4)" in note
    assert "1 without any edge (5)" in note


def test_self_loops_are_ignored_and_counted_and_parallel_edges_average() -> None:
    edges = np.array([[0, 1], [0, 1], [1, 1]])
    motion = np.broadcast_to(np.eye(4), (3, 4, 4)).copy()
    motion[:, 0, 3] = [1.0, 1.2, 5.0]
    start = np.broadcast_to(np.eye(4), (2, 4, 4)).copy()
    solution = PoissonSolver().solve(ViewGraph.from_edges(np.arange(2), edges, motion), start)
    assert solution.world_from_cam[1, 0, 3] == pytest.approx(1.1)
    assert solution.weights.tolist() == [1.0, 1.0, 0.0]
    assert any("1 edge joins a vertex to itself" in note for note in solution.notes)


def good_graph() -> tuple[ViewGraph, Floats]:
    rng = np.random.default_rng(0)
    truth = motions(rng, 3)
    return measured(np.array([[0, 1], [1, 2]]), truth, rng), truth


def broken(name: str, row: int, value: float) -> ViewGraph:
    graph, _ = good_graph()
    getattr(graph, name)[row] = value
    return graph


@pytest.mark.parametrize(
    ("graph", "words"),
    [
        (broken("information", 1, np.inf), "information is not finite"),
        (broken("edges", 0, 7), "3 vertices"),
    ],
)
def test_numbers_that_cannot_be_used_are_named(graph: ViewGraph, words: str) -> None:
    with pytest.raises(GraphError, match=words):
        PoissonSolver().solve(graph, good_graph()[1])


def test_poses_that_cannot_be_used_are_named() -> None:
    graph, truth = good_graph()
    with pytest.raises(GraphError, match="3 vertices need"):
        PoissonSolver().solve(graph, truth[:2])
    truth[2, 0, 0] = np.nan
    with pytest.raises(GraphError, match="vertex 2"):
        PoissonSolver().solve(graph, truth)
