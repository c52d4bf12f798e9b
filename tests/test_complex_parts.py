"""The complex of a viewing graph, ω on it and its parts, as a round has them."""

import numpy as np
import pytest

from hodge_pipeline import se3
from hodge_pipeline.complex import parts
from hodge_pipeline.complex.parts import ComplexOptions, decompose, one_form
from hodge_pipeline.errors import GraphError
from hodge_pipeline.types import CloudSet, PointCloud, ViewGraph

TRIANGLE = np.array([[0, 1], [1, 2], [0, 2]])


def graph_of(edges: np.ndarray, poses: np.ndarray, wrong: dict[int, np.ndarray] | None = None) -> ViewGraph:
    """Edges that agree with the poses, but for the `wrong` ones, which a twist spoils."""
    i, j = edges.T
    motions = se3.inverse(poses[i]) @ poses[j]
    for row, twist in (wrong or {}).items():
        motions[row] = motions[row] @ se3.exp(twist)
    return ViewGraph.from_edges(np.arange(len(poses)), edges, motions)


def poses_of(count: int) -> np.ndarray:
    return se3.exp(np.random.default_rng(3).normal(size=(count, 6)) * np.repeat([0.1, 1.0], 3))


def clouds_at(*places: float) -> CloudSet:
    return CloudSet.from_clouds([PointCloud(np.array([[x, 0, 0]], np.float32)) for x in places])


def shares(graph: ViewGraph, poses: np.ndarray) -> dict[str, tuple[float, float]]:
    flag = ComplexOptions().of(graph, clouds_at(*range(len(poses))), poses)
    return decompose(flag, one_form(graph, poses)).energies(flag.counts).shares


def test_poses_that_are_off_are_exact_and_a_wrong_edge_of_a_triangle_is_not_harmonic() -> None:
    poses = poses_of(3)
    moved = poses.copy()
    moved[2, 0, 3] += 0.1
    assert shares(graph_of(TRIANGLE, poses), moved)["exact"][1] == pytest.approx(1, abs=1e-3)
    spoiled = shares(graph_of(TRIANGLE, poses, {1: np.array([0, 0, 0, 0.1, 0, 0])}), poses)
    assert spoiled["coexact"][1] == pytest.approx(1 / 3, abs=0.02)
    assert spoiled["harmonic"][1] == pytest.approx(0, abs=1e-12)


def test_a_wrong_edge_of_a_loop_that_no_triangle_fills_is_harmonic() -> None:
    square, poses = np.array([[0, 1], [1, 2], [2, 3], [0, 3]]), poses_of(4)
    spoiled = shares(graph_of(square, poses, {1: np.array([0, 0, 0, 0.1, 0, 0])}), poses)
    assert spoiled["harmonic"][1] == pytest.approx(1 / 4, abs=0.02)
    assert spoiled["coexact"] == (0, 0)


def test_the_nerve_keeps_a_triangle_where_three_clouds_share_a_voxel() -> None:
    poses = np.tile(np.eye(4), (3, 1, 1))
    graph = graph_of(TRIANGLE, poses)
    options = ComplexOptions(nerve=True, voxel_m=0.5)
    assert options.of(graph, clouds_at(0.1, 0.2, 0.3), poses).counts == (3, 3, 1)
    assert options.of(graph, clouds_at(0.1, 0.2, 0.7), poses).counts == (3, 3, 0)
    assert ComplexOptions().of(graph, clouds_at(0.1, 0.2, 0.7), poses).counts == (3, 3, 1)


def test_too_many_triangles_are_refused_by_number(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(parts, "MOST_TRIANGLES", 0)
    with pytest.raises(GraphError, match="1 triangles, more than 0"):
        ComplexOptions().of(graph_of(TRIANGLE, poses_of(3)), clouds_at(0, 1, 2), poses_of(3))
