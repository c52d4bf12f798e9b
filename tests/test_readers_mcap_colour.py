"""Colour of a recording that is of another camera than its depth, as a RealSense gives where it does not align them."""

import io
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from hodge_adapters.mcap.reader import McapReader
from hodge_pipeline import se3
from hodge_pipeline.testing import check_reader
from hodge_pipeline.types import Camera
from mcap_data import Log, calibration, foxglove_header, raw_image, transforms
from mcap_encoding import CDR

DEPTH_CAMERA, COLOUR_CAMERA = Camera(64, 48, 50, 50, 31.5, 23.5), Camera(160, 120, 100, 100, 80, 59)
COLOUR_FROM_DEPTH = se3.exp(np.array([0.02, -0.05, 0.03, -0.05, 0.01, 0.02]))
LENS = [-0.4, 0.1, 0.005, -0.005, 0.0]
CORNERS_M = np.array([[-0.5, -0.35, 1.0], [0.4, -0.35, 1.0], [0.4, 0.35, 1.0], [-0.5, 0.35, 1.0]])
BOARD_M = np.concatenate([np.linspace(a, b, 20) for a, b in zip(CORNERS_M, np.roll(CORNERS_M, -1, 0), strict=True)])
"""The rim of a board 1 m ahead, before a wall at 2 m, in the depth camera's axes."""


def painted(camera: Camera, d: list[float], rim_m: np.ndarray, colours: tuple[int, int]) -> np.ndarray:
    rim = cv2.projectPoints(rim_m, np.zeros(3), np.zeros(3), camera.matrix, np.array(d))[0]
    image = np.full((camera.height, camera.width), colours[0], np.uint16)
    return cv2.fillPoly(image, [np.round(rim).astype(np.int32)], colours[1])


def recording(path: Path, colour_camera: Camera = COLOUR_CAMERA, linked: bool = True) -> Path:
    log = Log()
    depth = painted(DEPTH_CAMERA, [0.0] * 5, BOARD_M, (2000, 1000))
    grey = painted(colour_camera, LENS, se3.transform(COLOUR_FROM_DEPTH, BOARD_M), (40, 220)).astype(np.uint8)
    for name, camera, d, image in (
        ("depth", DEPTH_CAMERA, [0.0] * 5, raw_image(depth, "16UC1")),
        ("color", colour_camera, LENS, raw_image(grey[..., None].repeat(3, axis=2), "rgb8")),
    ):
        head = foxglove_header(100 + 0.004 * (name == "color"), name)
        info = calibration(camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
        log.add(f"/cam/{name}/camera_info", "foxglove.CameraCalibration", {**head, **info, "D": d}, CDR)
        log.add(f"/cam/{name}/image_raw", "foxglove.RawImage", {**head, **image}, CDR)
    if linked:
        link = transforms((0, "color", "depth", COLOUR_FROM_DEPTH))
        log.add("/tf_static", "tf2_msgs/msg/TFMessage", link, CDR)
    return log.write(path)


def test_it_is_brought_onto_the_pixels_of_depth(tmp_path: Path) -> None:
    source = check_reader(McapReader(), recording(tmp_path / "log.mcap"))
    (frame,) = source.frames
    assert frame.read_depth and frame.read_colour and frame.encoded_colour
    assert frame.colour_delay_s == pytest.approx(0.004)
    board, colour = frame.read_depth() < 1.5, frame.read_colour()
    assert colour.shape == (48, 64, 3)
    assert ((colour[..., 0] > 130) == board).mean() > 0.96
    coded = cv2.imdecode(np.frombuffer(frame.encoded_colour().contents, np.uint8), cv2.IMREAD_COLOR)
    assert np.abs(coded.astype(int) - colour).mean() < 5
    assert any("brought onto its pixels" in note for note in source.notes)


def test_of_another_camera_that_nothing_places_it_is_left_out(tmp_path: Path) -> None:
    same_size = Camera(64, 48, 60, 60, 31.5, 23.5)
    source = McapReader().open(recording(tmp_path / "log.mcap", same_size, linked=False))
    assert source.frames[0].read_colour is None
    assert any("camera_info of both and /tf_static" in note for note in source.notes)
    assert McapReader(colour_camera="same").open(tmp_path / "log.mcap").frames[0].read_colour is not None


def test_with_the_intrinsics_of_depth_it_is_registered(tmp_path: Path) -> None:
    """Drivers that register depth copy the calibration, and some keep the old name of the coordinate frame."""
    source = McapReader().open(recording(tmp_path / "log.mcap", DEPTH_CAMERA))
    assert source.frames[0].read_colour is not None
    assert any("colour is off by as much" in note for note in source.notes)


def test_a_phones_jpeg_is_read_as_it_is_stored(tmp_path: Path) -> None:
    """Its EXIF block names an orientation, by which OpenCV turned it: it was said not to be decoded."""
    exif, coded, log = Image.Exif(), io.BytesIO(), Log()
    exif[0x112] = 6  # the right-hand side is the top
    picture = np.repeat(np.uint8([[[0]], [[255]]]), 24, axis=0).repeat(64, axis=1).repeat(3, axis=2)
    Image.fromarray(picture).save(coded, "jpeg", exif=exif, quality=100)
    head, (wide, high) = foxglove_header(100, "cam"), (DEPTH_CAMERA.width, DEPTH_CAMERA.height)
    log.add("/info", "foxglove.CameraCalibration", {**head, **calibration(wide, high, 50, 50, 31.5, 23.5)}, CDR)
    log.add("/depth", "foxglove.RawImage", {**head, **raw_image(np.full((high, wide), 1000, np.uint16), "16UC1")}, CDR)
    log.add("/colour", "foxglove.CompressedImage", {**head, "format": "jpeg", "data": coded.getvalue()}, CDR)
    (frame,) = McapReader().open(log.write(tmp_path / "phone.mcap")).frames
    assert frame.read_colour is not None
    np.testing.assert_allclose(frame.read_colour().astype(int), picture, atol=40)
