"""Images of a lens that distorts, bent straight."""

from functools import partial
from pathlib import Path

import cv2
import numpy as np

from hodge_adapters.images.camera_files import read_intrinsics
from hodge_adapters.images.frames import (
    Lens,
    encoded_undistorted_depth,
    undistorted,
    undistorted_colour,
    undistorted_depth,
)
from hodge_adapters.tum.reader import CAMERAS, TumReader
from hodge_pipeline.types import Camera, Floats32, Frame

CAMERA = Camera(640, 480, 517.3, 516.5, 318.6, 255.3)
FR1 = CAMERAS["fr1"].distortion
assert FR1 is not None
LENS = Lens(CAMERA, FR1)


def dot(column: int, row: int) -> Floats32:
    image = np.zeros((480, 640), np.float32)
    image[row - 1 : row + 2, column - 1 : column + 2] = 2.0
    return image


def test_a_point_lands_where_the_pinhole_sees_its_ray() -> None:
    ray = np.array([[[-0.45, -0.35, 1.0]]])
    seen = cv2.projectPoints(ray, np.zeros(3), np.zeros(3), CAMERA.matrix, np.array(FR1))[0].ravel()
    meant = (CAMERA.matrix @ ray.ravel())[:2]
    assert np.linalg.norm(seen - meant) > 3
    straight = undistorted_depth(partial(dot, *np.round(seen).astype(int)), LENS)
    rows, columns = np.nonzero(straight)
    np.testing.assert_allclose([columns.mean(), rows.mean()], meant, atol=1.0)
    assert set(np.unique(straight)) == {0.0, 2.0}, "depth is never mixed with what lies behind"


def test_without_distortion_images_stay_as_they_are() -> None:
    none = Lens(CAMERA, (0.0, 0.0, 0.0, 0.0, 0.0))
    rng = np.random.default_rng(0)
    depth, colour = rng.uniform(0, 5, (480, 640)).astype(np.float32), rng.integers(0, 255, (480, 640, 3), np.uint8)
    np.testing.assert_array_equal(undistorted_depth(lambda: depth, none), depth)
    np.testing.assert_array_equal(undistorted_colour(lambda: colour, none), colour)


def test_encoded_images_are_the_straight_ones() -> None:
    depth = encoded_undistorted_depth(partial(dot, 300, 200), LENS, 5000.0)
    stored = cv2.imdecode(np.frombuffer(depth.contents, np.uint8), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(stored / 5000.0, undistorted_depth(partial(dot, 300, 200), LENS))
    seen = Frame(0, 0.0, LENS.camera, read_colour=lambda: np.full((480, 640, 3), (200, 10, 10), np.uint8))
    encoded_colour = undistorted(seen, LENS, 5000.0).encoded_colour
    assert encoded_colour is not None
    colour = encoded_colour()
    middle = cv2.imdecode(np.frombuffer(colour.contents, np.uint8), cv2.IMREAD_COLOR)[240, 320]
    np.testing.assert_allclose(middle, (10, 10, 200), atol=4)


def test_a_camera_file_gives_its_coefficients(tmp_path: Path) -> None:
    keys = {"fx": 500, "fy": 500, "cx": 320, "cy": 240, "k1": 0.1, "k2": -0.2, "p1": 0.01, "p2": 0.0}
    (tmp_path / "TUM1.yaml").write_text("".join(f"Camera.{key}: {value}\n" for key, value in keys.items()))
    found = read_intrinsics(tmp_path / "TUM1.yaml")
    assert found.distorted and found.distortion == (0.1, -0.2, 0.01, 0.0, 0.0)
    (tmp_path / "plain.yaml").write_text("fx: 500\nfy: 500\ncx: 320\ncy: 240\n")
    assert read_intrinsics(tmp_path / "plain.yaml").distortion is None


def test_the_reader_undistorts_fr1_and_notes_it(data_dir: Path) -> None:
    source = TumReader().open(data_dir / "tum" / "fr1_rpy_part")
    raw = TumReader(undistort=False).open(data_dir / "tum" / "fr1_rpy_part")
    assert any("removed from" in note for note in source.notes) and any("left in" in note for note in raw.notes)
    straight, distorted = (one.frames[0].read_depth for one in (source, raw))
    assert straight and distorted and (straight() != distorted()).mean() > 0.1
    np.testing.assert_allclose(straight()[230:280, 290:350], distorted()[230:280, 290:350], atol=0.2)
