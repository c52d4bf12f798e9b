"""What is taken for a video, and the clock of frames whose stamps are none."""

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from hodge_pipeline.start import key_frames as tracked
from hodge_pipeline.start.key_frames import is_video
from hodge_pipeline.types import Frame, Source


@pytest.mark.parametrize("begin_s", [0.0, 1e9])
def test_only_the_step_over_which_a_clock_goes_back_is_made_up(begin_s: float) -> None:
    stamps = begin_s + np.array([0.25, 0.5, 1.0, 1.25, -7.0, -6.5, -6.25])
    source = Source("s", Path("s"), tuple(Frame(row, stamp) for row, stamp in enumerate(stamps.tolist())))
    np.testing.assert_allclose(tracked.stamps_of(source) - begin_s, [0.25, 0.5, 1.0, 1.25, 1.5, 2.0, 2.25])


@pytest.mark.parametrize(
    "stamps", [[0.5] * 5, [1.5, 1.5, 1.5, 2.5, 2.5], [3.0, 4.0, 1.0, 2.0, 3.0], [0.5, 0.5001, 0.5002, 0.6, 0.6001]]
)
def test_stamps_that_are_no_clock_are_the_numbers_of_the_frames(stamps: list[float]) -> None:
    source = Source("s", Path("s"), tuple(Frame(row, stamp) for row, stamp in enumerate(stamps)))
    np.testing.assert_array_equal(tracked.stamps_of(source), np.arange(5))


@pytest.mark.parametrize(
    ("step_s", "first_s", "numbered_hz", "is_tracked"),
    [
        (1 / 30, 0.5, 0.0, True),
        (0.7, 0.5, 0.0, False),
        (1.0, 0.0, 0.0, False),
        (4.0, 0.0, 30.0, True),
        (8.0, 0.0, 30.0, False),
    ],
)
def test_stills_and_frames_without_a_clock_are_no_video(
    step_s: float, first_s: float, numbered_hz: float, is_tracked: bool
) -> None:
    frames = tuple(Frame(row, first_s + row * step_s, read_depth=partial(np.ones, (6, 8))) for row in range(60))
    assert is_video(Source("s", Path("s"), frames, numbered_hz=numbered_hz)) == is_tracked
    scans = tuple(replace(frame, read_depth=None) for frame in frames)
    assert not is_video(Source("s", Path("s"), scans, numbered_hz=numbered_hz))
