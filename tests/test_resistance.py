"""Effective resistances of edges: exact in small graphs, and bridges told from other edges in graphs of any size."""

from __future__ import annotations

import numpy as np
import pytest

from diagnosis_graphs import every_pair_tried
from hodge_pipeline.complex.series import series_classes
from hodge_pipeline.diagnosis.diagnosis import diagnose
from hodge_pipeline.solvers.resistance import EXACT_TO, Network, effective_resistance
from hodge_pipeline.types import Floats, Ints


def resistance(edges: Ints, count: int) -> Floats:
    """Of edges all of which are used."""
    return effective_resistance(edges, np.ones(len(edges), bool), Network.of(edges, count))


def ring(count: int) -> Ints:
    return np.stack([np.arange(count), (np.arange(count) + 1) % count], axis=1)


@pytest.mark.parametrize("count", [3, 100, 1200])
def test_round_a_ring_the_way_is_as_long_as_all_other_edges(count: int) -> None:
    """From a thousand edges on they were taken for bridges."""
    np.testing.assert_allclose(resistance(ring(count), count), count - 1, rtol=1e-6)


@pytest.mark.parametrize("count", [200, EXACT_TO + 100])
def test_bridges_and_they_alone_have_no_way_round(count: int) -> None:
    """Of 1600 vertices 196 edges were taken for bridges, 3 of which were."""
    path, far = ring(count)[:-1], np.random.default_rng(0).integers(0, count, (count // 4, 2))
    edges = np.concatenate([path, far[np.abs(np.diff(far, axis=1)[:, 0]) > 1]])
    np.testing.assert_array_equal(np.isinf(resistance(edges, count)), series_classes(edges, count) < 0)


def test_the_leverage_of_an_edge_is_that_among_the_edges_kept() -> None:
    graph, _, _ = every_pair_tried(0, views=20)
    found = diagnose(graph)
    expected = 1 - 1 / (1 + effective_resistance(graph.edges, found.kept, Network.of(graph.edges[found.kept], 20)))
    np.testing.assert_allclose(found.leverage, np.where(found.kept, expected, 0.0))
