"""Motions that are the inverse of what they are read as are told by how cycles close."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from backbone_graphs import drive
from hodge_pipeline import se3
from hodge_pipeline.complex.conventions import inverted_notes, nearest_tree
from hodge_pipeline.refine.pose_graph import read_graph
from hodge_pipeline.types import ViewGraph


def inverted(graph: ViewGraph) -> ViewGraph:
    return replace(graph, i_from_j=se3.inverse(graph.i_from_j))


@pytest.mark.parametrize("wrong", [0.0, 0.3])
def test_inverted_motions_are_told_and_swapped_ids_mend_them(wrong: float) -> None:
    graph = inverted(drive(dimension=3, world="room", wrong=wrong, seed=2).graph)
    (note,) = inverted_notes(graph)
    assert "swap the two ids of each edge" in note
    assert not inverted_notes(replace(graph, edges=graph.edges[:, ::-1]))


@pytest.mark.parametrize("world", ["ring", "town", "room", "corridor"])
@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("wrong", [0.0, 0.5, 1.0])
def test_nothing_is_said_of_motions_that_are_read_as_meant(world: str, dimension: int, wrong: float) -> None:
    for loops in (0, 3, 100):
        made = drive(seed=3, world=world, dimension=dimension, wrong=wrong, loops=loops)
        assert not inverted_notes(made.graph)


def test_exact_motions_and_few_cycles_say_nothing() -> None:
    straight = np.tile(np.eye(4), (8, 1, 1))
    straight[:, 0, 3] = [1, 1, 1, 1, 2, 2, 2, 3 + 1e-9]
    edges = np.array([[0, 1], [1, 2], [2, 3], [3, 4], [0, 2], [1, 3], [2, 4], [0, 3]])
    graph = ViewGraph.from_edges(np.arange(5), edges, straight, np.tile(np.eye(6), (8, 1, 1)))
    assert not inverted_notes(graph) and not inverted_notes(inverted(graph))
    assert not inverted_notes(graph.select(np.arange(0)))
    assert not inverted_notes(inverted(drive(dimension=3, world="room", wrong=0.0, loops=2, seed=2).graph))


def test_the_tree_is_of_the_nearest_vertices() -> None:
    edges = np.array([[0, 3], [2, 1], [1, 0], [2, 2], [1, 0], [3, 2], [5, 4]])
    np.testing.assert_array_equal(nearest_tree(edges, 6), [1, 2, 5, 6])


def test_a_file_with_inverted_motions_is_said_to_be_so(data_dir: Path, tmp_path: Path) -> None:
    lines = (data_dir / "pose_graphs/sesync/intel.g2o").read_text().splitlines()
    swapped = [" ".join([w[0], w[2], w[1], *w[3:]]) if (w := line.split())[0] == "EDGE_SE2" else line for line in lines]
    (tmp_path / "swapped.g2o").write_text("\n".join(swapped))
    assert "look inverted" in read_graph(tmp_path / "swapped.g2o").notes[0]
