"""Whether colour is of another moment than depth, of a camera that goes to and fro before boxes."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
import pytest

from hodge_pipeline.sources.colour_moment import late_doubts
from hodge_pipeline.sources.colour_on_depth import image_doubts, usable_colour
from hodge_pipeline.types import Frame, Source

WIDTH, HEIGHT, FRAMES, STEP_PX, TURN = 160, 120, 40, 4, 5


def passed(late: int, step_px: int = STEP_PX, delay_s: float = 0.0) -> list[Frame]:
    """Frames whose colour is of `late` frames before; colour is stamped so much later than depth."""
    rng = np.random.default_rng(0)
    long = WIDTH + TURN * step_px
    depth_m, colour = np.full((HEIGHT, long), 3.0, np.float32), np.full((HEIGHT, long, 3), 100, np.uint8)
    for nearer in np.linspace(2.5, 1.0, 20):
        (left, top), (wide, high) = rng.integers(0, (long - 30, HEIGHT - 40)), rng.integers(10, 30, 2)
        depth_m[top : top + high, left : left + wide] = nearer
        colour[top : top + high, left : left + wide] = rng.integers(0, 255, 3)
    frames = []
    for row in range(FRAMES):
        depth_at, colour_at = (step_px * abs((row - back) % (2 * TURN) - TURN) for back in (0, late))
        seen = depth_m[:, depth_at : depth_at + WIDTH], colour[:, colour_at : colour_at + WIDTH]
        read_depth, read_colour = (partial(np.copy, image) for image in seen)
        frames.append(Frame(row, row / 30, None, read_depth, read_colour, colour_delay_s=delay_s))
    return frames


@pytest.mark.parametrize("late", [0, 1, -1])
def test_colour_within_a_step_is_no_doubt(late: int) -> None:
    assert late_doubts(passed(late)) == ()


@pytest.mark.parametrize(("late", "told"), [(2, "2 frames later"), (-2, "2 frames earlier")])
def test_colour_of_another_moment_is_told_and_places_no_frame(late: int, told: str) -> None:
    frames = passed(late)
    (note,) = image_doubts(frames)
    assert (note.kind, note.detail) == ("colour of another moment", told)
    source = usable_colour(Source("late", Path("late"), frames), (note,))
    assert all(frame.read_colour is None and frame.read_depth is not None for frame in source.frames)
    assert late_doubts(frames[:9]) == (), "too few frames"


def test_stamps_that_tell_of_it_are_counted() -> None:
    assert late_doubts(passed(2, delay_s=-2 / 30)) == (), "its stamps say that colour is two steps earlier"
    (note,) = late_doubts(passed(1, delay_s=1 / 30))
    assert note.detail == "1 frame later", "stamped a step later, it is two steps off its own moment"


def test_a_camera_at_rest_tells_nothing() -> None:
    assert late_doubts(passed(2, step_px=0)) == ()
