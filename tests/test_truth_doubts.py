"""Whether the truth is of another convention, another clock, or another path than the result."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from hodge_pipeline import se3
from hodge_pipeline.report.truth import truth_doubts
from hodge_pipeline.scene import KeyFrames, Round
from hodge_pipeline.types import Edges, Floats, Frame, Solution, Source, Trajectory, ViewGraph
from hodge_pipeline.types.notes import Note

HZ, FRAMES = 30.0, 60


def path(seed: int, count: int = 40) -> Trajectory:
    """A hand-held camera's, `count` poses at 10 Hz, which turns and moves about all axes."""
    twists = np.random.default_rng(seed).normal(scale=0.04, size=(count, 6))
    poses = np.tile(np.eye(4), (count, 1, 1))
    for k in range(1, count):
        poses[k] = poses[k - 1] @ se3.exp(twists[k])
    return Trajectory(100.05 + 0.1 * np.arange(count), poses)


def doubts(truth: Trajectory, late_s: float = 0.0) -> tuple[Note, ...]:
    """On a truth so late, of frames that went along `path(0)` and drifted by some millimetres."""
    stamps_s = 100.5 + np.arange(FRAMES) / HZ
    drift = np.cumsum(np.random.default_rng(1).normal(scale=2e-4, size=(FRAMES, 6)), axis=0)
    result = se3.poses_at(path(0), stamps_s, 0.1) @ se3.exp(drift)
    truth = Trajectory(truth.stamps_s + late_s, truth.world_from_cam)
    true: Floats = se3.poses_at(truth, stamps_s, 0.1)
    frames = tuple(
        Frame(k, stamp, None, true_world_from_cam=pose if np.isfinite(pose).all() else None)
        for k, (stamp, pose) in enumerate(zip(stamps_s, true, strict=True))
    )
    source = Source("walk", Path("walk"), frames, trajectory=truth)
    edges = np.array([(k, k + 10) for k in range(FRAMES - 10)])
    graph = ViewGraph.from_edges(np.arange(FRAMES), edges, se3.inverse(result[edges[:, 0]]) @ result[edges[:, 1]])
    solution = Solution(result, np.zeros(FRAMES, np.int64), np.ones(len(edges)))
    last = Round(Edges.measured(graph), graph.vertex_ids, result, solution)
    return truth_doubts(source, KeyFrames.all_of(source, result), last, result, 1.0)


def test_a_sound_truth_is_not_doubted() -> None:
    assert doubts(path(0)) == ()
    assert doubts(path(0), 0.005) == ()


@pytest.mark.parametrize("late_s", [0.5, -0.2, 7200.0, -1e9])
def test_a_truth_of_another_clock_is_told_with_both_errors(late_s: float) -> None:
    (note,) = doubts(path(0), late_s)
    assert note.kind == "truth clock"
    told, error = note.detail.split(": ")
    whose, as_read = ("truth", "ATE ") if abs(late_s) < 1 else ("trajectory", "no frame has a pose near, ATE ")
    assert told == f"the {whose}'s clock is {abs(late_s):.2f} s {'late' if late_s > 0 else 'early'}"
    assert error.startswith(as_read)
    assert ("cm, " in error) == (whose == "truth")
    assert error.endswith(" mm with its stamps shifted")


def test_a_truth_of_another_convention_is_named() -> None:
    truth = path(0)
    inverse = Trajectory(truth.stamps_s, se3.inverse(truth.world_from_cam))
    (note,) = doubts(inverse)
    assert note.kind == "truth convention"
    assert note.detail.startswith("the true poses look like inverse poses, camera from world: as such they miss 0.0")


def test_a_truth_of_another_path_is_doubted() -> None:
    (note,) = doubts(path(7))
    assert note.kind == "truth unlike"
