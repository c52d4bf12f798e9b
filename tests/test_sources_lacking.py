"""What is said of frames without colour, or without a pose of the trajectory beside them."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from hodge_pipeline.errors import SourceError
from hodge_pipeline.sources.opening import check_measurable, lacking
from hodge_pipeline.types import Camera, Frame, Source, Trajectory

POSED = Frame(
    0,
    0.0,
    read_depth=partial(np.ones, (4, 4), np.float32),
    read_colour=partial(np.zeros, (4, 4, 3), np.uint8),
    world_from_cam=np.eye(4),
)
WITHOUT = replace(POSED, read_colour=None, world_from_cam=None)
TRAJECTORY = Trajectory(np.zeros(1), np.eye(4)[None])


def said(*frames: Frame, trajectory: Trajectory | None = TRAJECTORY) -> list[str]:
    return [str(note) for note in lacking(Source("s", Path("s"), frames, trajectory))]


def test_frames_that_lack_nothing_are_not_spoken_of() -> None:
    assert said(POSED, POSED) == []
    assert said(replace(POSED, world_from_cam=None), trajectory=None) == []
    assert said(replace(WITHOUT, read_depth=None), POSED) == []  # a scan


def test_frames_with_depth_and_no_colour_are_counted() -> None:
    assert said(POSED, WITHOUT) == ["1 of 2 frames with depth has no colour image: surfaces alone place it"]


def test_a_trajectory_that_is_of_no_frame_is_said() -> None:
    frames = (replace(POSED, world_from_cam=None),) * 3
    (note,) = said(*frames)
    assert note.startswith("the trajectory beside the 3 frames has no pose near in time of any")
    assert said(*frames, replace(frames[0], true_world_from_cam=np.eye(4))) == []


def test_where_nothing_can_be_registered_the_reader_says_why() -> None:
    check_measurable(Source("s", Path("s"), (Frame(0, 0.0), replace(POSED, camera=Camera(4, 4, 4, 4, 2, 2)))))
    left_out = "/depth: 40 left out: a message with pixels of the kind '64FC1'"
    with pytest.raises(SourceError, match=f"s: no frame has depth with a camera.*; {left_out}: hodge inspect"):
        check_measurable(Source("s", Path("s"), (Frame(0, 0.0), POSED), notes=(left_out,)))
