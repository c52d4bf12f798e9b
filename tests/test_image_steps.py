"""What images say of poses, and the guard that asks them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

import hodge_pipeline
from hodge_adapters.tum.reader import TumReader
from hodge_pipeline import se3
from hodge_pipeline.demo.sequence import DemoOptions, make_sequence
from hodge_pipeline.refine.against_images import step_errors
from hodge_pipeline.stages import Step
from hodge_pipeline.types import Floats32, Source

SMALL = ("clouds.voxel_m=0.06", "executor.workers=0", "recording.level=off", "outer_iterations=1")


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Source:
    options = DemoOptions(frames=16, width=160, height=120, noise=0.3)
    return TumReader().open(make_sequence(tmp_path_factory.mktemp("room") / "sequence", options))


def truth_of(room: Source) -> np.ndarray:
    return np.array([frame.world_from_cam for frame in room.frames])


def test_images_show_true_steps_and_no_others(room: Source, tmp_path: Path) -> None:
    truth = truth_of(room)
    moved = truth.copy()
    moved[1::2] = moved[1::2] @ se3.exp(np.array([0, 0, 0, 0.03, 0, 0]))
    pairs = np.array([[0, 1], [1, 2], [2, 3]])
    step = Step(tmp_path, lambda done: None, lambda *notes: None)
    off_m = step_errors(room, pairs, np.stack([truth, moved]), 1.0, step=step)[..., 0]
    assert off_m[0].max() < 0.015 < 0.02 < off_m[1].min()
    blind = replace(room, frames=tuple(replace(frame, read_colour=None) for frame in room.frames))
    assert np.isnan(step_errors(blind, pairs, truth[None], 1.0, step=step)).all()


def test_steps_are_seen_however_far_off_the_first_poses_are(room: Source, tmp_path: Path) -> None:
    """Pose 1 is turned by 60 degrees: corners followed from there are lost."""
    truth = truth_of(room)
    lost = truth.copy()
    lost[1] = lost[1] @ se3.exp(np.array([0, np.pi / 3, 0, 0, 0, 0]))
    step = Step(tmp_path, lambda done: None, lambda *notes: None)
    pairs = np.array([[0, 1], [1, 2]])
    assert np.isnan(step_errors(room, pairs, lost[None], 1.0, step=step)).all()
    off = step_errors(room, pairs, np.stack([lost, truth]), 1.0, step=step)
    np.testing.assert_allclose(off[0, :, 1], np.pi / 3, atol=0.02)
    assert off[1].max() < 0.02


def warped(read: Callable[[], Floats32], share: Floats32) -> Floats32:
    return np.asarray(read() * share, np.float32)


def test_depth_that_is_warped_alike_in_every_frame_makes_nothing_worse(room: Source) -> None:
    """Its clouds fit best on a path of a third the size, by pairs kept out too: 3 mm came out as 120."""
    truth, camera = truth_of(room), room.frames[0].camera
    assert camera is not None
    v, u = np.indices((camera.height, camera.width))
    radius = ((u - camera.cx) ** 2 + (v - camera.cy) ** 2) / (camera.cx**2 + camera.cy**2)
    share = np.asarray(1 + 0.05 * radius, np.float32)
    frames = [replace(f, read_depth=partial(warped, f.read_depth, share)) for f in room.frames if f.read_depth]
    noise = np.random.default_rng(1).normal(0, 1, (len(truth), 6)) * [0.0035, 0.0035, 0.0035, 0.0024, 0.0024, 0.0024]
    given = truth @ se3.exp(noise)
    refined = hodge_pipeline.refine_trajectory(given, frames, recipe="slam_refine", overrides=SMALL)
    assert refined.decision.outcome == "worse" and refined.poses is given
    assert "change of the path's size" in refined.decision.reason
    assert "path scaled" in {note.kind for note in refined.report.notes}
