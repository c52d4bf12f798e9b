"""Whether edges close better than by chance: what confirms the poses of a robust solve."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hodge_pipeline import open_source, se3
from hodge_pipeline.complex.closing import closes_better_than_chance
from hodge_pipeline.types import Ints, ViewGraph


def lattice(size: int) -> Ints:
    """The edges (E, 2) of a square lattice of size × size vertices."""
    rows = np.arange(size * size).reshape(size, size)
    return np.concatenate(
        [np.stack([rows[:, :-1], rows[:, 1:]], 2).reshape(-1, 2), np.stack([rows[:-1], rows[1:]], 2).reshape(-1, 2)]
    )


@pytest.mark.parametrize("turn_rad", [0.3, 3.0])
@pytest.mark.parametrize("flat", [False, True])
@pytest.mark.parametrize("size", [6, 20, 34])
def test_random_edges_of_a_lattice_are_not_confirmed(size: int, flat: bool, turn_rad: float) -> None:
    """Cycles of random edges that share edges are no evidence each: as many as these once seemed to be."""
    for seed in range(4):
        rng = np.random.default_rng(seed)
        scale = np.array([0, 0, turn_rad, 1, 1, 0]) if flat else np.repeat([turn_rad, 1.0], 3)
        edges = lattice(size)
        graph = ViewGraph.from_edges(np.arange(size**2), edges, se3.exp(rng.normal(size=(len(edges), 6)) * scale))
        assert not closes_better_than_chance(graph, np.arange(graph.edge_count))
        assert not closes_better_than_chance(graph, np.arange(1, graph.edge_count))


def test_long_cycles_that_gather_noise_do_not_hide_short_ones_that_close() -> None:
    rng = np.random.default_rng(0)
    truth = se3.exp(rng.normal(size=(1156, 6)) * np.repeat([1.0, 0.0], 3))
    truth[:, :2, 3] = 8 * np.stack(np.divmod(np.arange(1156), 34), axis=1)
    edges = lattice(34)
    noise = se3.exp(rng.normal(size=(len(edges), 6)) * np.repeat([0.3, 2.0], 3))
    motions = se3.inverse(truth[edges[:, 0]]) @ truth[edges[:, 1]] @ noise
    graph = ViewGraph.from_edges(np.arange(1156), edges, motions)
    assert closes_better_than_chance(graph, np.arange(1, len(edges)))
    apart = replace(graph, i_from_j=motions[rng.permutation(len(edges))])
    assert not closes_better_than_chance(apart, np.arange(1, len(edges)))


@pytest.mark.filterwarnings("error")
def test_edges_that_do_not_move_among_others_are_computed_with() -> None:
    edges = lattice(6)
    motions = se3.exp(np.random.default_rng(0).normal(size=(len(edges), 6)))
    motions[::2] = np.eye(4)
    graph = ViewGraph.from_edges(np.arange(36), edges, motions)
    assert not closes_better_than_chance(graph, np.arange(len(edges)))


def test_loops_moved_to_random_places_are_not_confirmed(data_dir: Path) -> None:
    """The path between them runs straight, farther than a walk at random of its steps."""
    graph = open_source(data_dir / "pose_graphs/slam_loops/bicocca/B25b_1.000.g2o").graph
    assert graph is not None
    edges, loops = graph.edges.copy(), np.flatnonzero(np.abs(np.diff(graph.edges, axis=1)[:, 0]) != 1)
    edges[loops] = np.random.default_rng(0).integers(0, graph.vertex_count, (len(loops), 2))
    moved = replace(graph, edges=edges)
    assert not closes_better_than_chance(moved, np.arange(graph.edge_count))
