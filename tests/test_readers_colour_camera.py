"""Colour of a camera beside the depth camera, brought onto the depth image's pixels."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from hodge_adapters.seven_scenes.reader import SevenScenesReader, colour_pixels
from hodge_pipeline.testing import check_reader
from hodge_pipeline.types import Camera
from readers_data import seven_scenes_sequence

DEPTH_CAMERA = Camera(8, 6, 585.0, 585.0, 4.0, 3.0)


def test_a_camera_to_the_right_sees_things_further_left() -> None:
    """Of 525 pixels of focal length, 2.5 cm beside: 6.5625 pixels at 2 m, twice as many at 1 m."""
    depth = np.full((6, 8), 2.0, np.float32)
    depth[:, 4:] = 1.0
    columns, rows = colour_pixels(depth, DEPTH_CAMERA)
    wider = 525 / 585
    expected = 4 + wider * (np.arange(8) - 4) - np.repeat([6.5625, 13.125], 4)
    np.testing.assert_allclose(columns[2], expected, atol=1e-5)
    np.testing.assert_allclose(rows[:, 0], 3 + wider * (np.arange(6) - 3), atol=1e-5)


def test_pixels_without_depth_are_taken_for_the_median() -> None:
    depth = np.full((6, 8), 2.0, np.float32)
    depth[0, 0] = 0.0
    columns, _ = colour_pixels(depth, DEPTH_CAMERA)
    assert columns[0, 0] == pytest.approx(columns[1, 0])


def test_the_option_of_the_reader(tmp_path: Path) -> None:
    folder = seven_scenes_sequence(tmp_path / "seq-01")
    kinect = check_reader(SevenScenesReader(colour_camera="kinect"), folder)
    assert kinect.frames[0].read_colour().shape == (6, 8, 3) and kinect.frames[0].encoded_colour is None


def edge_contrast(reader: SevenScenesReader, folder: Path) -> float:
    """The colour gradient at edges of the depth, over that of the whole image."""
    ratios = []
    for frame in reader.open(folder).frames[::50]:
        depth, colour = frame.read_depth(), frame.read_colour()
        grey = cv2.GaussianBlur(cv2.cvtColor(colour, cv2.COLOR_RGB2GRAY).astype(np.float32), (0, 0), 1)
        gradient = np.hypot(cv2.Sobel(grey, -1, 1, 0), cv2.Sobel(grey, -1, 0, 1))
        gradient = np.minimum(gradient, np.percentile(gradient, 95))
        nearest, farthest = cv2.erode(depth, np.ones((3, 3))), cv2.dilate(depth, np.ones((3, 3)))
        inside = np.zeros(depth.shape, bool)
        inside[30:-30, 30:-30] = True
        edges = (farthest - nearest > 0.15) & (nearest > 0) & inside
        ratios.append(gradient[edges].mean() / gradient[inside].mean())
    return float(np.mean(ratios))


def test_colour_edges_fall_on_depth_edges_of_a_real_scene(data_dir: Path) -> None:
    folder = data_dir / "seven_scenes/redkitchen"
    same, kinect = (edge_contrast(SevenScenesReader(colour_camera=name), folder) for name in ("same", "kinect"))
    assert kinect > 1.2 * same
