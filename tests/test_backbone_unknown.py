"""Rings whose edges state no information, so that their errors are learned from one right loop."""

import numpy as np

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
