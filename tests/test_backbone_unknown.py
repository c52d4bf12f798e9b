"""Errors learned from one right loop, since edges state none, and from edges that have none at all."""

import numpy as np
import pytest

from hodge_pipeline import se3
from hodge_pipeline.diagnosis.diagnosis import diagnose
from hodge_pipeline.types import ViewGraph


def ring(seed: int, count: int, turn: float, wrong: int) -> ViewGraph:
    """Steps of 2 m that err by 2 cm and `turn` radians, the right loop that closes them, and up to `wrong` others."""
    rng = np.random.default_rng(seed)
    yaw, radius = 2 * np.pi * np.arange(count) / count, count / np.pi
    places = np.stack([radius * np.sin(yaw), radius - radius * np.cos(yaw), 0 * yaw], axis=1)
    poses = se3.from_parts(se3.so3_exp(np.outer(yaw, [0.0, 0.0, 1.0])), places)
    edges = np.stack([np.arange(count), np.roll(np.arange(count), -1)], axis=1)
    noise = rng.normal(size=(count, 6)) * np.repeat([turn, 0.02], 3)
    motions = se3.inverse(poses[edges[:, 0]]) @ poses[edges[:, 1]] @ se3.exp(noise)
    rng = np.random.default_rng(seed)
    pairs = [np.sort(rng.choice(count, 2, replace=False)) for _ in range(wrong)]
    more = np.array([pair for pair in pairs if pair[1] - pair[0] > 3], np.int64).reshape(-1, 2)
    motions = np.concatenate([motions, motions[rng.integers(0, count, len(more))]])
    information = np.tile(np.eye(6), (len(motions), 1, 1))
    return ViewGraph.from_edges(np.arange(count), np.concatenate([edges, more]), motions, information)


def test_the_only_loop_of_a_long_path_is_not_called_wrong_by_what_the_descent_leaves() -> None:
    found = diagnose(ring(9, 100, 0.005, wrong=0))
    assert found.verdict[-1] == "consistent"
    assert found.kept.all()


def test_no_loop_is_called_wrong_where_none_is_used() -> None:
    graph = ring(11, 60, 0.01, wrong=8)
    found = diagnose(graph)
    loop = np.abs(np.diff(graph.edges, axis=1))[:, 0] > 1
    assert not found.kept[loop].any()
    assert set(found.verdict[loop].tolist()) == {"suspect"}
    assert any("nothing confirms" in note for note in found.notes)


@pytest.mark.filterwarnings("error")
def test_edges_without_any_error_are_consistent() -> None:
    """Thirty steps of a metre out and back: the errors learned of residuals that are exactly 0 had no inverse."""
    places = np.zeros((60, 3))
    places[:, 0] = np.append(np.arange(30), np.arange(30)[::-1])
    poses = se3.from_parts(np.broadcast_to(np.eye(3), (60, 3, 3)), places)
    loops = [(i, 59 - i) for i in range(0, 28, 3)] + [(0, 20), (3, 25)]
    edges = np.array([(i, i + 1) for i in range(59)] + loops)
    motions = se3.inverse(poses[edges[:, 0]]) @ poses[edges[:, 1]]
    information = np.tile(100 * np.eye(6), (len(edges), 1, 1))
    assert diagnose(ViewGraph.from_edges(np.arange(60), edges, motions, information)).kept.all()
