"""Whether depth is in metres, by its range and by the steps in which sensors measure it."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from hodge_adapters.seven_scenes.reader import SevenScenesReader
from hodge_adapters.tum.reader import TumReader
from hodge_pipeline.cli.list import next_command
from hodge_pipeline.sources.colour_on_depth import image_doubts
from hodge_pipeline.sources.depth_units import PRIMESENSE_STEP, doubts_of, inverse_step
from hodge_pipeline.sources.inspect import inspect
from hodge_pipeline.types import Floats32, Frame
from readers_data import tum_folder, write_colour, write_depth

PIXELS = 20


def in_steps(step: float, nearest_m: float = 0.6, farthest_m: float = 5.0) -> Floats32:
    """All depths of a sensor whose disparity has equal steps, rounded to the millimetre."""
    z = 1 / np.arange(1 / farthest_m, 1 / nearest_m, step)
    return np.repeat(np.round(z, 3), PIXELS).astype(np.float32)


def kinds(depth_m: Floats32) -> list[str]:
    return [note.kind for note in doubts_of(depth_m)]


@pytest.mark.parametrize("step", [PRIMESENSE_STEP, 1.63e-3, 1.01e-3])
def test_the_step_is_found_and_other_sensors_are_no_doubt(step: float) -> None:
    depth_m = in_steps(step)
    found = inverse_step(depth_m)
    assert found == pytest.approx(step, rel=0.01)
    some = np.random.default_rng(0).random(len(depth_m) // PIXELS) < 0.9  # not every value occurs
    assert inverse_step(depth_m[np.repeat(some, PIXELS)]) == pytest.approx(step, rel=0.01)
    assert kinds(depth_m) == []


def test_depth_without_steps_has_none() -> None:
    rng = np.random.default_rng(1)
    even = np.repeat(np.arange(600, 6000) / 1000, PIXELS).astype(np.float32)
    sparse = np.repeat(np.sort(rng.choice(np.arange(600, 6000), 500, replace=False)) / 1000, PIXELS)
    assert inverse_step(even) is None
    assert inverse_step(sparse.astype(np.float32)) is None
    assert inverse_step(np.full(50, 2.0, np.float32)) is None
    assert kinds(even) == []


@pytest.mark.parametrize(
    ("factor", "kind"), [(0.2, "depth unit"), (5.0, "depth unit"), (8.0, "depth unit"), (1.2, "depth steps"),
                         (0.83, "depth steps"), (1.0, ""), (1.02, "")],
)  # fmt: skip
def test_a_kinect_in_another_unit_is_told(factor: float, kind: str) -> None:
    depth_m = in_steps(PRIMESENSE_STEP) * np.float32(factor)
    assert kinds(depth_m) == ([kind] if kind else [])
    if kind:
        times = float(doubts_of(depth_m)[0].detail.split("depth_scale ")[1].split(" times")[0])
        assert times == pytest.approx(factor, rel=0.02)


@pytest.mark.parametrize(
    ("scale", "kind"), [(5000.0, ""), (1000.0, "depth unit"), (25000.0, "depth unit"), (6000.0, "depth steps")]
)
def test_a_real_kinect(scale: float, kind: str, data_dir: Path) -> None:
    frames = TumReader(depth_scale=scale).open(data_dir / "tum/fr1_rpy_part").frames
    assert [note.kind for note in image_doubts(frames)] == ([kind] if kind else [])


def test_a_real_kinect_of_millimetres(data_dir: Path) -> None:
    assert image_doubts(SevenScenesReader().open(data_dir / "seven_scenes/redkitchen").frames) == ()


def test_what_lies_too_near_or_too_far_is_asked_about() -> None:
    even = np.repeat(np.arange(600, 6000) / 1000, PIXELS).astype(np.float32)
    assert "within 1.2 m" in str(doubts_of(even / 5)[0])
    assert "beyond 23.2 m" in str(doubts_of(even * 5)[0])
    assert "median depth is 3.3e+03 m" in str(doubts_of(even * 1000)[0])
    desk = np.concatenate([np.repeat(even, 3), np.repeat(even * 10, 1)]) / 20  # mostly .2 m, some beyond 2 m
    assert "median depth is 0.2" in str(doubts_of(desk)[0])
    assert doubts_of(np.zeros(10, np.float32)) == ()


@pytest.mark.parametrize(
    ("step", "width_px", "kind"),
    [(1.63e-3, 640, "depth unit"), (1.01e-3, 640, "depth range"), (1.63e-3, 320, "depth range")],
)
def test_nearer_than_a_camera_of_such_steps_sees_is_another_unit(step: float, width_px: int, kind: str) -> None:
    """A RealSense's millimetres read at 5000 per metre; steps as fine as a close-up camera's may be of one."""
    near = in_steps(step) / np.float32(5)
    assert np.median(near) < 0.25
    (note,) = doubts_of(near, width_px)
    assert note.kind == kind and ("depth_scale=1000" in note.detail) == (kind == "depth unit")


def test_the_unit_that_is_told_is_in_the_next_command(tmp_path: Path) -> None:
    tum_folder(tmp_path)
    (tmp_path / "intrinsics.txt").write_text("525 525 319.5 239.5 640 480")
    millimetres = np.resize(np.round(1000 * in_steps(1.63e-3, 0.6, 2.0)), (480, 640)).astype(np.uint16)
    for image in (tmp_path / "depth").iterdir():
        write_depth(image, millimetres)
        write_colour(tmp_path / f"rgb/{float(image.stem) + 0.01:.6f}.png", size=(480, 640))
    found = inspect(tmp_path)
    assert any("source.reader.depth_scale=1000" in odd for odd in found["oddities"])
    assert " --set source.reader.depth_scale=1000 " in next_command(tmp_path, found, None)
    assert "missing" not in inspect(tmp_path, TumReader(depth_scale=4999))


def test_images_that_cannot_be_read_are_passed_over() -> None:
    def unreadable() -> Floats32:
        raise OSError("gone")

    near = Frame(0, 0.0, read_depth=partial(np.full, (3, 4), 0.4, np.float32))
    assert len(image_doubts([near, replace(near, read_depth=unreadable)])) == 1
    assert image_doubts([replace(near, read_depth=unreadable), replace(near, read_depth=None)]) == ()
