"""Named little graphs and random ones for the tests of the topology."""

from __future__ import annotations

import numpy as np
from hypothesis import strategies as st

from hodge_pipeline import se3
from hodge_pipeline.types import Floats, Ints

#   2
#  / \
# 0---1
TRIANGLE = np.array([[0, 1], [1, 2], [0, 2]])
# 3---2
# |   |
# 0---1
SQUARE = np.array([[0, 1], [1, 2], [2, 3], [3, 0]])
# 3---2
# | / |
# 0---1
TWO_TRIANGLES = np.array([[0, 1], [1, 2], [0, 2], [2, 3], [0, 3]])
#  1       3
#  | \   / |
#  |   0   |
#  | /   \ |
#  2       4
FIGURE_EIGHT = np.array([[0, 1], [1, 2], [2, 0], [0, 3], [3, 4], [4, 0]])


def complete(count: int) -> Ints:
    """K_n."""
    return np.stack(np.triu_indices(count, 1), axis=1)


def torus_grid(side: int) -> Ints:
    """A square grid whose opposite sides are glued."""
    row = np.arange(side * side).reshape(side, side)
    right, down = np.roll(row, -1, axis=1), np.roll(row, -1, axis=0)
    return np.vstack([np.stack([row.ravel(), right.ravel()], 1), np.stack([row.ravel(), down.ravel()], 1)])


def torus_rotation(side: int) -> Ints:
    """The darts of `torus_grid` around each vertex in the order right, down, left, up."""
    row = np.arange(side * side).reshape(side, side)
    count = side * side
    left, up = np.roll(row, 1, axis=1), np.roll(row, 1, axis=0)
    darts = [2 * row, 2 * (count + row), 2 * left + 1, 2 * (count + up) + 1]
    return np.stack([dart.ravel() for dart in darts], axis=1).ravel()


@st.composite
def graphs(draw: st.DrawFn, most_vertices: int = 9, most_edges: int = 16) -> tuple[Ints, int]:
    """Any multigraph: parallel edges, self-loops, several pieces, isolated vertices."""
    count = draw(st.integers(1, most_vertices))
    vertex = st.integers(0, count - 1)
    edges = draw(st.lists(st.tuples(vertex, vertex), max_size=most_edges))
    return np.array(edges, np.int64).reshape(-1, 2), count


def random_motions(seed: int, count: int, size: float = 1.0) -> Floats:
    """Motions (count, 4, 4) of random twists."""
    return se3.exp(np.random.default_rng(seed).normal(size=(count, 6)) * size)
