"""Whether depth and colour lie on each other, by the edges that both show."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest

from hodge_adapters.seven_scenes.reader import SevenScenesReader
from hodge_pipeline.recipe.schema import load_recipe
from hodge_pipeline.sources.colour_on_depth import image_doubts
from hodge_pipeline.store.store import Store
from hodge_pipeline.types import Bytes, Camera, Floats32, Frame, Source
from hodge_pipeline.types.notes import Note
from hodge_pipeline.uses.recipe_run import _Run

WIDTH, HEIGHT = 320, 240


def boxes(seed: int) -> tuple[Floats32, Bytes]:
    """Depth and colour of boxes before a wall, with texture of their own."""
    rng = np.random.default_rng(seed)
    depth_m = np.full((HEIGHT, WIDTH), 3.0, np.float32)
    colour = rng.integers(100, 110, (HEIGHT, WIDTH, 3)).astype(np.uint8)
    for nearer in np.linspace(2.5, 1.0, 12):
        (left, top), (wide, high) = rng.integers(0, (WIDTH - 60, HEIGHT - 60)), rng.integers(20, 60, 2)
        depth_m[top : top + high, left : left + wide] = nearer
        colour[top : top + high, left : left + wide] = rng.integers(0, 255, 3)
    return depth_m, colour


def doubts(scale: float, right: float, count: int = 6) -> tuple[Note, ...]:
    return image_doubts(boxes_beside(scale, right, count))


def boxes_beside(scale: float, right: float, count: int = 6) -> list[Frame]:
    """Frames whose depth is to be scaled and shifted to lie on colour."""
    to_depth = np.array([[1 / scale, 0, WIDTH / 2 * (1 - 1 / scale) - right / scale], [0, 1, 0]])
    to_depth[1] = [0, 1 / scale, HEIGHT / 2 * (1 - 1 / scale)]
    camera, frames = Camera(WIDTH, HEIGHT, 260.0, 260.0, 159.5, 119.5), []
    for number in range(count):
        depth_m, colour = boxes(number)
        warped = cv2.warpAffine(depth_m, to_depth, (WIDTH, HEIGHT), flags=cv2.INTER_NEAREST)
        frames.append(Frame(number, number / 30, camera, partial(np.copy, warped), partial(np.copy, colour)))
    return frames


@pytest.mark.parametrize(("scale", "right"), [(1.0, 0.0), (1.02, 3.0)])
def test_depth_on_colour_is_no_doubt(scale: float, right: float) -> None:
    assert doubts(scale, right) == ()


@pytest.mark.parametrize(("scale", "right"), [(0.9, 0.0), (1.57, 0.0), (1.0, 14.0)])
def test_depth_beside_colour_is_told(scale: float, right: float) -> None:
    (note,) = doubts(scale, right)
    assert note.kind == "colour beside depth"
    placed, camera = note.detail.split(" than as it is, ")
    assert placed == f"scaled by {scale:.2f} and shifted by {right:.0f} and 0 pixels"
    assert camera == "of a camera of focal length 260 pixels (source.reader.camera)"
    assert doubts(scale, right, count=4) == ()


@pytest.mark.parametrize(("right", "is_used"), [(0.0, True), (14.0, False)])
def test_a_run_places_frames_by_surfaces_alone_where_colour_is_not_on_depth(
    tmp_path: Path, right: float, is_used: bool
) -> None:
    store = Store(tmp_path)
    opened = Source("boxes", tmp_path, boxes_beside(1.0, right))
    source, _ = _Run(load_recipe("tum", source=tmp_path), tmp_path, store, opened=opened)._read()
    assert [frame.read_colour is not None for frame in source.frames] == [is_used] * 6
    assert all(frame.read_depth is not None for frame in source.frames)


def test_a_real_kinect(data_dir: Path) -> None:
    kitchen = data_dir / "seven_scenes/redkitchen_100"
    assert image_doubts(SevenScenesReader().open(kitchen).frames) == ()
    (note,) = image_doubts(SevenScenesReader(colour_camera="same").open(kitchen).frames)
    assert note.detail.startswith("scaled by 0.90 and shifted by ")
