"""Colour of a camera beside the depth camera, brought onto the depth image's pixels."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from hodge_adapters.seven_scenes.reader import LIRIS, NOMINAL, ColourCamera, SevenScenesReader, colour_pixels
from hodge_pipeline import se3
from hodge_pipeline.errors import RecipeError
from hodge_pipeline.recipe.schema import load_recipe
from hodge_pipeline.testing import check_reader
from hodge_pipeline.types import Camera
from readers_data import seven_scenes_sequence

DEPTH_CAMERA = Camera(8, 6, 10.0, 10.0, 4.0, 3.0)


def test_the_published_motions_are_motions() -> None:
    for values in (NOMINAL, LIRIS):
        assert se3.is_motion(np.reshape(values, (4, 4)), 1e-6)


def test_a_camera_to_the_right_sees_things_further_left() -> None:
    """Ten pixels of focal length, 0.2 m beside, at 2 m: one pixel; 1 m: two pixels."""
    depth = np.full((6, 8), 2.0, np.float32)
    depth[:, 4:] = 1.0
    motion = se3.from_parts(np.eye(3), np.array([-0.2, 0.0, 0.0]))
    columns, rows = colour_pixels(depth, DEPTH_CAMERA, ColourCamera(DEPTH_CAMERA, tuple(motion.ravel())))
    np.testing.assert_allclose(columns[2], [-1, 0, 1, 2, 2, 3, 4, 5], atol=1e-5)
    np.testing.assert_allclose(rows[:, 0], range(6), atol=1e-5)


def test_pixels_without_depth_are_taken_for_the_median_and_what_lies_behind_for_nothing() -> None:
    depth = np.full((6, 8), 2.0, np.float32)
    depth[0, 0] = 0.0
    beside = se3.from_parts(np.eye(3), np.array([0.2, 0.0, 0.0]))
    columns, _ = colour_pixels(depth, DEPTH_CAMERA, ColourCamera(DEPTH_CAMERA, tuple(beside.ravel())))
    assert columns[0, 0] == pytest.approx(1.0)
    behind = se3.from_parts(np.eye(3), np.array([0.0, 0.0, -5.0]))
    columns, rows = colour_pixels(depth, DEPTH_CAMERA, ColourCamera(DEPTH_CAMERA, tuple(behind.ravel())))
    assert (columns == -1).all() and (rows == -1).all()


def test_the_option_of_the_reader(tmp_path: Path) -> None:
    folder = seven_scenes_sequence(tmp_path / "seq-01")
    image = np.zeros((6, 8, 3), np.uint8)
    image[:, 3] = 255
    for path in folder.glob("*.color.png"):
        cv2.imwrite(str(path), image)
    plain = check_reader(SevenScenesReader(), folder)
    identity = check_reader(SevenScenesReader(colour_from_depth=tuple(np.eye(4).ravel())), folder)
    for a, b in zip(plain.frames, identity.frames, strict=True):
        np.testing.assert_array_equal(a.read_colour(), b.read_colour())
        assert b.encoded_colour is None and a.encoded_colour is not None
    wider = check_reader(SevenScenesReader(colour_intrinsics=(5.0, 5.0, 4.0, 3.0)), folder)
    # Half the focal length: column 3 of the colour image, one left of the centre, is two left of it in depth's.
    assert wider.frames[0].read_colour()[2, :, 0].tolist() == [0, 128, 255, 128, 0, 0, 0, 0]
    kinect = check_reader(SevenScenesReader(colour_camera="kinect"), folder)
    assert kinect.frames[0].read_colour().shape == (6, 8, 3)


@pytest.mark.parametrize("values", [[1.0] * 16, [1.0, 0.0, 0.0]])
def test_a_motion_that_is_none_is_refused(values: list[float]) -> None:
    with pytest.raises(RecipeError, match="colour_from_depth"):
        load_recipe("seven_scenes", [f"source.reader.colour_from_depth={values}"])


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
    same, kinect, liris = (
        edge_contrast(SevenScenesReader(colour_camera=name), folder) for name in ("same", "kinect", "liris")
    )
    assert kinect > liris > 1.1 * same
