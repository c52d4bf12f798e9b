"""The paper's solver: laws on random graphs, hand answers, seeds, odd graphs, bad input."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from complex_graphs import TRIANGLE, complete, graphs, random_motions
from hodge_paper.solver import PaperSolver
from hodge_paper.surface import make_surface
from hodge_pipeline import se3
from hodge_pipeline.complex.decomposition import gradient_fit
from hodge_pipeline.solvers.poisson import PoissonSolver
from hodge_pipeline.types import Floats, Ints, Solution, ViewGraph

SOLVER = PaperSolver(log="se3", inner_iterations=12)


def measured(edges: Ints, truth: Floats, noise: float, seed: int = 0) -> ViewGraph:
    i, j = edges.T
    wrong = se3.exp(np.random.default_rng(seed).normal(size=(len(edges), 6)) * noise)
    return ViewGraph.from_edges(np.arange(len(truth)), edges, se3.inverse(truth[i]) @ truth[j] @ wrong)


def start_near(truth: Floats, seed: int = 1, size: float = 0.02) -> Floats:
    return truth @ se3.exp(np.random.default_rng(seed).normal(size=(len(truth), 6)) * size)


def relative(poses: Floats) -> Floats:
    return se3.inverse(poses[:1]) @ poses


@given(
    seed=st.integers(0, 9999), rotation=st.sampled_from(["random", "angular"]), log=st.sampled_from(["se3", "pairing"])
)
@settings(max_examples=15, deadline=None)
def test_consistent_edges_give_back_the_truth_whatever_the_embedding(seed: int, rotation: str, log: str) -> None:
    truth = random_motions(seed, 7, 0.7)
    solver = PaperSolver(rotation=rotation, seed=seed, log=log, inner_iterations=15)
    start = start_near(truth, seed)
    solution = solver.solve(measured(complete(7), truth, 0.0), start)
    np.testing.assert_allclose(relative(solution.world_from_cam), relative(truth), atol=1e-8)
    np.testing.assert_array_equal(solution.world_from_cam[0], start[0])


@given(graph=graphs(), seed=st.integers(0, 99))
@settings(max_examples=25, deadline=None)
def test_any_multigraph_is_solved_and_its_surface_is_closed(graph: tuple[Ints, int], seed: int) -> None:
    edges, count = graph
    truth = random_motions(seed, count, 0.3)
    solution = PaperSolver(seed=seed).solve(measured(edges, truth, 0.05, seed), start_near(truth))
    assert se3.is_motion(solution.world_from_cam).all()
    proper = edges[:, 0] != edges[:, 1]
    np.testing.assert_array_equal(solution.weights, proper.astype(float))
    if proper.any():
        pieces = int(solution.component.max()) + 1
        isolated = count - len(np.unique(edges[proper]))
        cells = solution.metrics["cells"] + isolated
        assert count - proper.sum() + cells == 2 * pieces - 2 * solution.metrics["genus"]
        shares = [v for k, v in solution.metrics.items() if k.startswith("share_") and k.endswith("_rotation")]
        assert sum(shares) == pytest.approx(1.0, abs=1e-6)


@given(seed=st.integers(0, 999))
@settings(max_examples=10, deadline=None)
def test_flipping_and_shifting_change_nothing_with_the_logarithm_of_se3(seed: int) -> None:
    rng = np.random.default_rng(seed)
    truth = random_motions(seed, 8)
    edges = complete(8)
    graph, start = measured(edges, truth, 0.05, seed), start_near(truth)
    expected = SOLVER.solve(graph, start)

    flip = rng.random(len(edges)) < 0.5
    flipped, motions = edges.copy(), graph.i_from_j.copy()
    flipped[flip], motions[flip] = edges[flip, ::-1], se3.inverse(motions[flip])
    order = rng.permutation(len(edges))
    other = SOLVER.solve(ViewGraph.from_edges(graph.vertex_ids, flipped[order], motions[order]), start)
    np.testing.assert_allclose(relative(other.world_from_cam), relative(expected.world_from_cam), atol=1e-8)

    shift = np.eye(4)
    shift[:3, 3] = [200.0, -30.0, 5.0]
    moved = SOLVER.solve(graph, shift @ start)
    np.testing.assert_allclose(relative(moved.world_from_cam), relative(expected.world_from_cam), atol=1e-8)


def test_the_papers_pairing_depends_on_the_directions_and_se3_does_not() -> None:
    truth = random_motions(3, 8)
    graph, start = measured(complete(8), truth, 0.1), start_near(truth)
    back = ViewGraph.from_edges(graph.vertex_ids, graph.edges[:, ::-1], se3.inverse(graph.i_from_j))

    def difference(log: str) -> float:
        solver = PaperSolver(log=log, inner_iterations=12)
        first, second = (relative(solver.solve(g, start).world_from_cam) for g in (graph, back))
        return float(np.abs(first - second).max())

    assert difference("se3") < 1e-9
    assert 1e-4 < difference("pairing") < 0.1


def test_a_tree_is_one_cell_and_is_followed_exactly() -> None:
    #  1   3
    #   \ /
    #    0---2
    edges = np.array([[0, 1], [0, 2], [3, 0]])
    truth = random_motions(2, 4)
    solution = SOLVER.solve(measured(edges, truth, 0.0), start_near(truth))
    assert (solution.metrics["cells"], solution.metrics["genus"], solution.metrics["loops"]) == (1, 0, 0)
    np.testing.assert_allclose(relative(solution.world_from_cam), relative(truth), atol=1e-9)
    assert any("3 bridges" in note for note in solution.notes)


def test_a_triangle_spreads_its_disagreement_evenly() -> None:
    start = np.broadcast_to(np.eye(4), (3, 4, 4)).copy()
    motions = start.copy()
    motions[0, 0, 3] = 0.03
    solution = SOLVER.solve(ViewGraph.from_edges(np.arange(3), TRIANGLE, motions), start)
    x = relative(solution.world_from_cam)[:, 0, 3]
    np.testing.assert_allclose([x[1], x[2] - x[1], -x[2]], [0.02, -0.01, -0.01], atol=1e-12)
    assert solution.metrics["measured_loop_deviation_sum"] == pytest.approx(0.03)


def test_the_loop_deviation_falls_to_nothing_while_the_measured_one_stays() -> None:
    truth = random_motions(8, 12, 0.5)
    solution = PaperSolver().solve(measured(complete(12), truth, 0.02), start_near(truth, size=0.05))
    deviation = [step.metrics["loop_deviation_sum"] for step in solution.history]
    assert solution.metrics["measured_loop_deviation_sum"] > 1.0
    assert deviation[1] < 0.02 * deviation[0]
    assert deviation[2] < 1e-5
    homology = [step.metrics["homology_rotation_mean"] for step in solution.history]
    assert homology[2] < 1e-6 < homology[0] < solution.metrics["measured_homology_rotation_mean"]


def test_seeds_give_different_surfaces_and_the_same_seed_the_same_poses() -> None:
    truth = random_motions(4, 10, 0.5)
    graph, start = measured(complete(10), truth, 0.02), start_near(truth)

    def solve(seed: int) -> Solution:
        return PaperSolver(seed=seed).solve(graph, start)

    np.testing.assert_array_equal(solve(1).world_from_cam, solve(1).world_from_cam)
    apart = np.abs(solve(1).world_from_cam - solve(2).world_from_cam).max()
    assert 1e-6 < apart < 0.05


def test_without_diagonals_the_surface_solves_what_the_graph_solves() -> None:
    # K4 drawn flat, a triangle around its centre: four triangles on a sphere
    edges = complete(4)
    truth = random_motions(6, 4, 0.5)
    truth[:, :3, 3] = [[0, 0, 0], [1, 0, 0], [-0.5, 0.8, 0], [-0.5, -0.8, 0]]
    surface = make_surface(edges, truth, "angular", 0)
    assert (surface.embedding.genus, surface.sizes()["diagonals"]) == (0, 0)
    graph = measured(edges, truth, 0.03)
    paper = PaperSolver(rotation="angular", log="se3").solve(graph, truth).world_from_cam
    plain = PoissonSolver().solve(graph, truth).world_from_cam
    np.testing.assert_allclose(paper, plain, atol=1e-12)


def test_half_turns_are_reported() -> None:
    motions = np.broadcast_to(np.eye(4), (3, 4, 4)).copy()
    motions[2, :3, :3] = se3.so3_exp(np.array([0.0, np.pi, 0.0]))
    start = np.broadcast_to(np.eye(4), (3, 4, 4))
    solution = PaperSolver().solve(ViewGraph.from_edges(np.arange(3), TRIANGLE, motions), start)
    assert any("half turn" in note for note in solution.notes)


def test_the_surface_is_the_graph_with_weights_between_edges() -> None:
    # each diagonal's residual is the sum of its path's residuals, so with F the extension of a form to the surface the
    # Poisson equation is least squares on the graph alone, in the norm FᵀF / √3 instead of a diagonal one
    edges = complete(9)
    truth = random_motions(9, 9, 0.5)
    surface = make_surface(edges, truth, "random", 2)
    assert surface.sizes()["diagonals"] > 20
    omega = np.random.default_rng(0).normal(size=(len(edges), 6))
    extension = surface.form(np.eye(len(edges)))
    d0 = surface.d0[: len(edges)].toarray()
    root = extension @ d0
    expected = np.linalg.lstsq(root, extension @ omega, rcond=None)[0]
    found = gradient_fit(surface.d0, surface.form(omega), surface.weights)
    np.testing.assert_allclose(d0 @ found, d0 @ expected, atol=1e-10)
