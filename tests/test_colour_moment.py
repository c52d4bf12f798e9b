"""Whether colour is of another moment than depth, of a camera that goes to and fro before boxes."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from hodge_pipeline.sources import colour_moment
from hodge_pipeline.sources.colour_moment import late_doubts, paired_anew
from hodge_pipeline.sources.colour_on_depth import image_doubts, usable_colour
from hodge_pipeline.types import Frame, Source

WIDTH, HEIGHT, FRAMES, SWAY_PX = 160, 120, 40, 20


def passed(late: int, sway_px: int = SWAY_PX, steps_px: int = 0, delay_s: float = 0.0) -> list[Frame]:
    """Frames whose colour is of `late` frames before, and is stamped so much later than depth; the camera sways to and
    fro, or goes so many pixels to the right with each frame.
    """
    rng, long = np.random.default_rng(0), WIDTH + 4 * SWAY_PX + FRAMES * steps_px
    depth_m, colour = np.full((HEIGHT, long), 3.0, np.float32), np.full((HEIGHT, long, 3), 100, np.uint8)
    for nearer in np.linspace(2.5, 1.0, 20 + 4 * FRAMES * steps_px // WIDTH):
        (left, top), (wide, high) = rng.integers(0, (long - 30, HEIGHT - 40)), rng.integers(10, 30, 2)
        depth_m[top : top + high, left : left + wide] = nearer
        colour[top : top + high, left : left + wide] = rng.integers(0, 255, 3)
    frames = []
    for row in range(FRAMES):
        moments = np.array([row, row - late])
        at = 2 * SWAY_PX + sway_px * (np.sin(0.5 * moments) + np.sin(0.21 * moments))
        at = (at + np.clip(moments, 0, FRAMES) * steps_px).astype(int)
        seen = depth_m[:, at[0] : at[0] + WIDTH], colour[:, at[1] : at[1] + WIDTH]
        read_depth, read_colour = (partial(np.copy, image) for image in seen)
        frames.append(Frame(row, row / 30, None, read_depth, read_colour, colour_delay_s=delay_s))
    return frames


@pytest.mark.parametrize("late", [0, 1, -1])
def test_colour_within_a_step_is_no_doubt(late: int) -> None:
    assert late_doubts(passed(late)) == ()


@pytest.mark.parametrize(("late", "told"), [(2, "2 frames later"), (-3, "3 frames earlier")])
def test_colour_of_another_moment_is_paired_anew_by_whole_frames(late: int, told: str) -> None:
    frames = passed(late)
    (note,) = image_doubts(frames)
    assert (note.kind, note.count, note.detail) == ("colour paired anew", late, told)
    mended = usable_colour(Source("late", Path("late"), frames), (note,)).frames
    for row, (frame, right) in enumerate(zip(mended, passed(0), strict=True)):
        assert frame.read_depth is not None and right.read_colour is not None
        if 0 <= row + late < FRAMES:
            assert frame.read_colour is not None and (frame.read_colour() == right.read_colour()).all()
        else:
            assert frame.read_colour is None, "no frame has its colour"
    assert late_doubts(mended) == ()


def test_of_a_camera_that_goes_on_steadily_late_colour_is_not_taken_for_colour_beside_depth() -> None:
    (note,) = image_doubts(passed(2, sway_px=2, steps_px=4))
    assert (note.kind, note.count) == ("colour paired anew", 2)


def test_colour_beside_depth_is_not_taken_for_that_of_another_moment() -> None:
    frames = [
        replace(frame, read_colour=partial(np.roll, frame.read_colour(), 9, 1))
        for frame in passed(0)
        if frame.read_colour
    ]
    assert [note.kind for note in image_doubts(frames)] == ["colour beside depth"]


def test_no_colour_is_taken_from_another_sequence() -> None:
    first, second = passed(2)[:3], [replace(frame, sequence="2") for frame in passed(2)[:3]]
    mended = paired_anew([*first, *second], 2)
    assert [frame.read_colour is None for frame in mended] == [False, True, True] * 2


def test_delays_of_pairs_made_anew_count_from_the_usual_one() -> None:
    delays_s = 0.06, 0.07, 0.05, 0.06
    frames = [replace(frame, colour_delay_s=delay) for frame, delay in zip(passed(0), delays_s, strict=False)]
    assert [frame.colour_delay_s for frame in paired_anew(frames, 1)[:3]] == pytest.approx([0.01, -0.01, 0.0])


@pytest.mark.parametrize("late", [2, -2])
def test_colour_of_another_moment_places_no_frame_where_its_step_is_not_sure(late: int) -> None:
    frames = passed(late)[:14]  # too few to try the steps around
    (note,) = image_doubts(frames)
    assert (note.kind, note.detail) == ("colour of another moment", f"2 frames {'later' if late > 0 else 'earlier'}")
    source = usable_colour(Source("late", Path("late"), frames), (note,))
    assert all(frame.read_colour is None and frame.read_depth is not None for frame in source.frames)
    assert late_doubts(frames[:9]) == (), "too few frames"


def test_a_step_is_sure_only_inside_those_tried_and_far_above_those_beyond_its_neighbours() -> None:
    found = np.full((8, 13), 0.2)
    found[:, 8:11] = 0.7, 1.0, 0.9
    assert colour_moment._sure_step(found) == 3
    assert colour_moment._sure_step(np.roll(found, 3, axis=1)) is None, "still better beyond the last step, perhaps"
    found[:, 2] = 0.9
    assert colour_moment._sure_step(found) is None, "a camera that goes to and fro"


def test_frames_farther_apart_that_call_no_step_best_make_no_pairs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(colour_moment, "_sure_step", lambda found: 0)
    assert [note.kind for note in late_doubts(passed(2))] == ["colour of another moment"]


def test_stamps_that_tell_of_it_are_counted() -> None:
    assert late_doubts(passed(2, delay_s=-2 / 30)) == (), "its stamps say that colour is two steps earlier"
    (note,) = late_doubts(passed(1, delay_s=1 / 30))
    assert note.detail == "1 frame later", "stamped a step later, it is two steps off its own moment"


def test_a_camera_at_rest_tells_nothing() -> None:
    assert late_doubts(passed(2, sway_px=0)) == ()
