"""Algorithm 2 and the Hodge decomposition: the form on diagonals, cotangent weights, the three parts."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from betti import betti_numbers
from complex_graphs import SQUARE, TWO_TRIANGLES, complete, graphs, torus_grid, torus_rotation
from hodge_paper.cotangent import cotangent_weights
from hodge_paper.embedding import Surface, embed, triangulate
from hodge_paper.homology import homology_generators
from hodge_paper.rotation import random_rotation
from hodge_paper.shortest_paths import surface_form
from hodge_paper.surface import surface_decomposition
from hodge_pipeline.complex.cech import flag_complex
from hodge_pipeline.complex.coboundary import coboundary_0
from hodge_pipeline.complex.decomposition import HodgeDecomposition, hodge_decomposition
from hodge_pipeline.errors import GraphError
from hodge_pipeline.types import Floats, Ints


def random_surface(graph: tuple[Ints, int], seed: int) -> Surface:
    return triangulate(embed(*graph, random_rotation(graph[0], seed)))


def decomposed(surface: Surface, omega: Floats, weights: Floats) -> HodgeDecomposition:
    return surface_decomposition(coboundary_0(surface.edges, surface.vertex_count), surface.d1, omega, weights)


def check_parts(parts: HodgeDecomposition, omega: Floats) -> None:
    scale = float(np.abs(omega).max(initial=1.0))
    forms = (parts.exact, parts.coexact, parts.harmonic)
    np.testing.assert_allclose(sum(forms), omega, atol=1e-9 * scale)
    for a, b in ((0, 1), (0, 2), (1, 2)):
        assert np.abs(forms[a].T @ (parts.weights[:, None] * forms[b])).max() < 1e-9 * scale**2 * max(len(omega), 1)


@given(graph=graphs(), seed=st.integers(0, 1000))
@settings(max_examples=60, deadline=None)
def test_on_a_surface_the_parts_are_orthogonal_and_complete(graph: tuple[Ints, int], seed: int) -> None:
    surface, rng = random_surface(graph, seed), np.random.default_rng(seed)
    omega = rng.normal(size=(len(surface.edges), 6))
    parts = decomposed(surface, omega, rng.uniform(0.1, 10.0, len(surface.edges)))
    check_parts(parts, omega)
    np.testing.assert_allclose(surface.d1 @ parts.exact, 0.0, atol=1e-9)
    np.testing.assert_allclose(surface.d1 @ parts.harmonic, 0.0, atol=1e-9)


@given(graph=graphs(most_vertices=8, most_edges=25), seed=st.integers(0, 1000))
@settings(max_examples=60, deadline=None)
def test_on_the_flag_complex_too(graph: tuple[Ints, int], seed: int) -> None:
    complex_, rng = flag_complex(*graph), np.random.default_rng(seed)
    d0, d1 = complex_.coboundary(0), complex_.coboundary(1)
    omega = rng.normal(size=(complex_.counts[1], 6))
    parts = hodge_decomposition(d0, d1, omega, rng.uniform(0.1, 10.0, complex_.counts[1]))
    check_parts(parts, omega)
    np.testing.assert_allclose(d1 @ parts.harmonic, 0.0, atol=1e-8)
    if betti_numbers(complex_)[1] == 0:
        np.testing.assert_allclose(parts.harmonic, 0.0, atol=1e-8)


@given(graph=graphs(), seed=st.integers(0, 1000))
@settings(max_examples=40, deadline=None)
def test_an_exact_form_stays_exact_on_the_surface_under_any_metric(graph: tuple[Ints, int], seed: int) -> None:
    """The half of the paper's claim that holds: where ω is exact, the metric does not matter."""
    edges, count = graph
    surface, rng = random_surface(graph, seed), np.random.default_rng(seed)
    f = rng.normal(size=(count, 6))
    omega = surface_form(surface, coboundary_0(edges, count) @ f)
    np.testing.assert_allclose(omega, coboundary_0(surface.edges, count) @ f, atol=1e-12)
    for weights in (cotangent_weights(surface), rng.uniform(0.1, 10.0, len(surface.edges))):
        parts = decomposed(surface, omega, weights)
        np.testing.assert_allclose(parts.exact, omega, atol=1e-10)
        np.testing.assert_allclose(parts.coexact, 0.0, atol=1e-10)
        np.testing.assert_allclose(parts.harmonic, 0.0, atol=1e-10)


def test_the_exact_part_of_an_inexact_form_depends_on_the_metric() -> None:
    """The half that does not hold."""
    surface, rng = random_surface((complete(5), 5), 1), np.random.default_rng(1)
    omega = rng.normal(size=(len(surface.edges), 6))
    unit = decomposed(surface, omega, cotangent_weights(surface)).exact
    stretched = decomposed(surface, omega, rng.uniform(0.5, 0.7, len(surface.edges))).exact
    assert np.abs(unit - stretched).max() > 1e-2


def test_the_harmonic_forms_of_a_torus_are_two_dimensional() -> None:
    surface = triangulate(embed(torus_grid(4), 16, torus_rotation(4)))
    omega = np.random.default_rng(0).normal(size=(48, 10))
    harmonic = decomposed(surface, omega, np.ones(48)).harmonic
    singular = np.linalg.svd(harmonic, compute_uv=False)
    assert (singular > 1e-9).sum() == 2


def test_a_form_is_told_by_its_loops_on_the_torus() -> None:
    """A constant step to the right closes every cell but not the way around: all harmonic."""
    surface = triangulate(embed(torus_grid(4), 16, torus_rotation(4)))
    omega = np.zeros((32, 6))
    omega[:16, 3] = 0.1
    whole = surface_form(surface, omega)
    parts = decomposed(surface, whole, cotangent_weights(surface))
    shares = parts.energies().shares
    assert shares["harmonic"][1] == pytest.approx(1.0)
    assert shares["exact"] == pytest.approx((0.0, 0.0))
    around = homology_generators(embed(torus_grid(4), 16, torus_rotation(4))).incidence(32) @ omega
    np.testing.assert_allclose(np.sort(np.abs(around[:, 3])), [0.0, 0.4], atol=1e-12)


def test_a_square_that_does_not_close_is_harmonic_and_a_filled_one_is_curl() -> None:
    omega = np.zeros((4, 6))
    omega[:, 3] = [1.0, 1.0, 1.0, 3.0]  # on 0→1, 0→3, 1→2, 2→3
    square = flag_complex(SQUARE, 4)
    parts = hodge_decomposition(square.coboundary(0), square.coboundary(1), omega, np.ones(4))
    # around 0→1→2→3→0: 1 + 1 + 3 − 1 = 4, shared equally
    np.testing.assert_allclose(np.abs(parts.harmonic[:, 3]), 1.0)
    assert parts.energies().harmonic == pytest.approx((0.0, 4.0))
    filled = flag_complex(TWO_TRIANGLES, 4)
    omega = np.array([[1.0], [0.0], [0.0], [1.0], [1.0]])
    parts = hodge_decomposition(filled.coboundary(0), filled.coboundary(1), omega, np.ones(5))
    np.testing.assert_allclose(parts.harmonic, 0.0, atol=1e-12)
    assert (parts.coexact**2).sum() > 0.1


def test_unit_lengths_give_one_over_root_three_everywhere() -> None:
    edges = np.array([[0, 1], [1, 2], [0, 2], [2, 3], [4, 5], [6, 6]])
    surface = random_surface((edges, 8), 0)
    np.testing.assert_allclose(cotangent_weights(surface), 1 / np.sqrt(3))


def test_diagonals_take_the_shortest_path() -> None:
    """The ring 0→1→2→3→4→0 lies on a sphere between two cells, cut by diagonals from 0 and from 1."""
    ring = np.array([[0, 1], [1, 2], [2, 3], [3, 4], [4, 0]])
    surface = random_surface((ring, 5), 0)
    omega = np.array([[1.0], [10.0], [100.0], [1000.0], [10000.0]])
    form = surface_form(surface, omega)
    found = {tuple(pair): value for pair, value in zip(surface.edges[5:].tolist(), form[5:, 0], strict=True)}
    assert found == {(0, 2): 11.0, (0, 3): -11000.0, (1, 4): -10001.0, (1, 3): 110.0}


def test_self_loops_and_parallels_among_the_diagonals() -> None:
    """Wherever a diagonal joins a vertex to itself its ω is 0; where it repeats an edge, that edge's, signed."""
    edges = complete(5)
    omega = np.arange(1.0, 11.0)[:, None]
    of_pair = {**{(i, j): w for (i, j), w in zip(edges.tolist(), omega[:, 0], strict=True)}}
    seen = set()
    for seed in range(20):
        surface = random_surface((edges, 5), seed)
        for (a, b), value in zip(surface.edges[10:].tolist(), surface_form(surface, omega)[10:, 0], strict=True):
            seen.add("loop" if a == b else "forward" if a < b else "backward")
            assert value == (0.0 if a == b else of_pair.get((a, b), -of_pair.get((b, a), 0.0)))
    assert seen == {"loop", "forward", "backward"}


def test_numbers_that_cannot_be_used_are_named() -> None:
    surface, flag = random_surface((complete(4), 4), 0), flag_complex(complete(4), 4)
    with pytest.raises(GraphError, match="positive weights: 1 of"):
        weights = np.ones(6)
        weights[2] = -1.0
        hodge_decomposition(flag.coboundary(0), flag.coboundary(1), np.zeros((6, 6)), weights)
    with pytest.raises(GraphError, match="embedded graph has 6 edges"):
        surface_form(surface, np.zeros((5, 6)))
