from __future__ import annotations

import itertools
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from hodge_adapters.mcap.reader import McapReader
from hodge_adapters.seven_scenes.reader import SevenScenesReader
from hodge_adapters.tum.reader import TumReader
from hodge_pipeline.errors import SourceError
from hodge_pipeline.testing import check_reader
from hodge_pipeline.types import Camera, Frame
from mcap_data import (
    CALIBRATION,
    COLOUR,
    COMPRESSED,
    DEPTH,
    INFO,
    OPTICAL,
    RAW,
    SECOND,
    Log,
    calibration,
    compressed_depth,
    compressed_inverse_depth,
    depth_log,
    foxglove_header,
    png,
    raw_image,
    ros_header,
    some_images,
    write_depth_log,
)
from mcap_encoding import CDR, ENCODINGS, JSON, PROTOBUF
from readers_data import HEIGHT, WIDTH, depth_values
from synthetic import tiny_sequence  # noqa: F401


def stored(frame: Frame, units_per_metre: float) -> np.ndarray:
    """The 16-bit image that a folder's frame was read from."""
    assert frame.read_depth is not None
    return np.round(frame.read_depth().astype(float) * units_per_metre).astype(np.uint16)


FORMS: dict[str, tuple[str, Callable[[np.ndarray], dict[str, Any]]]] = {
    "raw": (RAW, partial(raw_image, encoding="16UC1")),
    "raw with padded rows": (RAW, partial(raw_image, encoding="16UC1", pad=6)),
    "compressedDepth png": (COMPRESSED, partial(compressed_depth, coding="png")),
    "compressedDepth rvl": (COMPRESSED, partial(compressed_depth, coding="rvl")),
    "bare 16-bit png": (COMPRESSED, lambda image: {"format": "png", "data": png(image)}),
}


@pytest.mark.parametrize(("form", "encoding"), list(itertools.product(FORMS, ENCODINGS)))
def test_the_same_depth_as_the_folder(
    tiny_sequence: Path,  # noqa: F811
    tmp_path: Path,
    form: str,
    encoding: str,
) -> None:
    folder = TumReader().open(tiny_sequence).frames[:3]
    schema, make = FORMS[form]
    assert folder[0].camera is not None
    images = [make(stored(frame, 5000)) for frame in folder]
    path = write_depth_log(tmp_path / "log.mcap", images, schema, encoding, folder[0].camera)
    source = check_reader(McapReader(depth_scale=5000), path)
    assert [frame.camera for frame in source.frames] == [frame.camera for frame in folder]
    assert [frame.stamp_s for frame in source.frames] == [100.0, 100.1, 100.2]
    for frame, expected in zip(source.frames, folder, strict=True):
        assert np.array_equal(frame.read_depth(), expected.read_depth())
    is_png = "png" in form
    assert all((frame.encoded_depth is not None) == is_png for frame in source.frames)
    if is_png:
        contents = np.frombuffer(source.frames[0].encoded_depth().contents, np.uint8)
        assert np.array_equal(cv2.imdecode(contents, cv2.IMREAD_UNCHANGED), stored(folder[0], 5000))


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_the_same_depth_in_floats(tiny_sequence: Path, tmp_path: Path, encoding: str) -> None:  # noqa: F811
    folder = TumReader().open(tiny_sequence).frames[:2]
    assert folder[0].camera is not None
    metres = [frame.read_depth() for frame in folder]
    holes = [np.where(depth == 0, np.nan, depth).astype(np.float32) for depth in metres]
    images = [raw_image(depth, "32FC1") for depth in holes]
    source = check_reader(McapReader(), write_depth_log(tmp_path / "a.mcap", images, RAW, encoding, folder[0].camera))
    assert all(np.array_equal(f.read_depth(), m) for f, m in zip(source.frames, metres, strict=True))
    for coding in ("png", "rvl"):
        images = [compressed_inverse_depth(depth, coding) for depth in metres]
        path = write_depth_log(tmp_path / f"{coding}.mcap", images, COMPRESSED, encoding, folder[0].camera)
        for frame, expected in zip(check_reader(McapReader(), path).frames, metres, strict=True):
            depth = frame.read_depth()
            assert np.array_equal(depth > 0, expected > 0)
            # One step of the inverse depth is z² / A; the writer rounds down, so depth comes out deeper by up to that.
            step = expected**2 / 10100 * 1.01 + 1e-5
            assert ((depth - expected >= -1e-5) & (depth - expected <= step)).all()


def test_the_same_depth_of_a_real_scene(data_dir: Path, tmp_path: Path) -> None:
    folder = SevenScenesReader(colour_camera="same").open(data_dir / "seven_scenes/redkitchen").frames[:2]
    assert folder[0].camera is not None
    images = [cv2.imread(str(frame.read_depth.args[0]), cv2.IMREAD_UNCHANGED) for frame in folder]
    for name, (schema, make) in FORMS.items():
        path = write_depth_log(
            tmp_path / f"{name}.mcap", [make(image) for image in images], schema, PROTOBUF, folder[0].camera
        )
        source = check_reader(McapReader(no_depth=(0, 65535)), path)
        assert all(
            np.array_equal(f.read_depth(), e.read_depth()) for f, e in zip(source.frames, folder, strict=True)
        ), name


def test_colour_by_header_stamp_when_log_times_differ(tmp_path: Path) -> None:
    log = depth_log(some_images(3))
    colours = [(255, 0, 0), (0, 255, 0), (0, 0, 255)]
    for row in (2, 0, 1):  # Logged in another order, long after; the headers say which belongs to which.
        image = np.full((HEIGHT, WIDTH, 3), colours[row], np.uint8)
        head = foxglove_header(100.005 + row / 10, OPTICAL)
        log.add(COLOUR, RAW, {**head, **raw_image(image, "rgb8")}, CDR, log_ns=(500 - row) * SECOND)
    source = check_reader(McapReader(), log.write(tmp_path / "log.mcap"))
    assert [tuple(frame.read_colour()[0, 0]) for frame in source.frames] == colours
    assert any("the log's clock differs" in note for note in source.notes)
    far = McapReader(max_difference_s=0.001).open(tmp_path / "log.mcap")
    assert all(frame.read_colour is None for frame in far.frames)
    assert any("have no colour of /cam/color/image within 0.001 s" in note for note in far.notes)


@pytest.mark.parametrize(
    ("encoding", "units", "metres"), [("32FC1", 1000, 2.0), ("32FC1", None, 2000.0), ("16UC1", None, 2.0)]
)
def test_depth_scale_is_the_unit_of_floats_too(
    encoding: str, units: float | None, metres: float, tmp_path: Path
) -> None:
    image = raw_image(np.full((6, 8), 2000, "u2" if encoding == "16UC1" else "f4"), encoding)
    log = Log()
    log.add(DEPTH, "sensor_msgs/msg/Image", {"header": ros_header(1, OPTICAL), **image}, CDR)
    source = McapReader(camera=(9, 9, 4, 3), depth_scale=units).open(log.write(tmp_path / "log.mcap"))
    assert source.frames[0].read_depth is not None
    np.testing.assert_allclose(source.frames[0].read_depth(), metres)


@pytest.mark.parametrize("encoding", ["16UC1", "32FC1"])
def test_raw_depth_of_a_big_endian_machine(tmp_path: Path, encoding: str) -> None:
    values = depth_values().astype("u2" if encoding == "16UC1" else "f4")
    image = raw_image(values.astype(values.dtype.newbyteorder(">")), encoding, pad=4)
    log = Log()
    log.add(DEPTH, "sensor_msgs/msg/Image", {"header": ros_header(1, OPTICAL), **image, "is_bigendian": 1}, CDR)
    source = check_reader(McapReader(camera=(9, 9, 4, 3), depth_scale=1), log.write(tmp_path / "log.mcap"))
    assert np.array_equal(source.frames[0].read_depth(), values.astype(np.float32))


@pytest.mark.parametrize(
    ("encoding", "pixel"),
    [
        ("rgb8", (10, 20, 30)),
        ("bgr8", (30, 20, 10)),
        ("rgba8", (10, 20, 30, 255)),
        ("bgra8", (30, 20, 10, 255)),
    ],
)
def test_raw_colour(tmp_path: Path, encoding: str, pixel: tuple[int, ...]) -> None:
    image = np.full((HEIGHT, WIDTH, len(pixel)), pixel, np.uint8)
    log = depth_log(some_images(1))
    log.add(COLOUR, RAW, {**foxglove_header(100, OPTICAL), **raw_image(image, encoding, pad=5)}, CDR)
    source = check_reader(McapReader(), log.write(tmp_path / "log.mcap"))
    assert (source.frames[0].read_colour() == (10, 20, 30)).all()


def test_bayer_patterns_start_at_the_first_row(tmp_path: Path) -> None:
    mosaic = np.zeros((HEIGHT, WIDTH), np.uint8)
    mosaic[::2, ::2] = 200  # All the light falls on the top left of each four pixels.
    for encoding, channel in (("bayer_rggb8", 0), ("bayer_bggr8", 2), ("bayer_grbg8", 1), ("bayer_gbrg8", 1)):
        log = depth_log(some_images(1))
        log.add(COLOUR, RAW, {**foxglove_header(100, OPTICAL), **raw_image(mosaic, encoding)}, CDR)
        source = McapReader().open(log.write(tmp_path / f"{encoding}.mcap"))
        means = source.frames[0].read_colour()[2:-2, 2:-2].reshape(-1, 3).mean(axis=0)
        assert means.argmax() == channel and means.sum() == means[channel], encoding


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_compressed_colour_is_passed_through(tmp_path: Path, encoding: str) -> None:
    image = np.full((HEIGHT, WIDTH, 3), (10, 20, 30), np.uint8)  # BGR
    log = depth_log(some_images(1), encoding=encoding)
    contents = {"format": "rgb8; png compressed bgr8", "data": png(image)}
    log.add(COLOUR + "/compressed", COMPRESSED, {**foxglove_header(100, OPTICAL), **contents}, encoding)
    frame = check_reader(McapReader(), log.write(tmp_path / "log.mcap")).frames[0]
    assert (frame.read_colour() == (30, 20, 10)).all()
    assert frame.encoded_colour().contents == png(image) and frame.encoded_colour().media_type == "image/png"


def test_colour_of_another_size_is_not_on_the_grid(tmp_path: Path) -> None:
    log = depth_log(some_images(1))
    image = raw_image(np.zeros((4, 4, 3), np.uint8), "rgb8")
    log.add(COLOUR, RAW, {**foxglove_header(100, OPTICAL), **image}, CDR)
    source = check_reader(McapReader(), log.write(tmp_path / "log.mcap"))
    assert source.frames[0].read_colour is None
    assert any("no colour: depth is 8x6, there is /cam/color/image 4x4" in note for note in source.notes)


def test_images_of_another_size_than_most_are_left_out(tmp_path: Path) -> None:
    small = raw_image(depth_values(0, (2, 2)), "16UC1")
    colour = raw_image(np.zeros((HEIGHT, WIDTH, 3), np.uint8), "rgb8")
    log = depth_log([*some_images(3), small, colour])
    source = check_reader(McapReader(), log.write(tmp_path / "log.mcap"))
    assert len(source.frames) == 3
    assert f"{DEPTH}: 2 images of another size or kind than most left out" in source.notes


def test_topics_by_type_and_by_option(tmp_path: Path) -> None:
    log = depth_log(some_images(2))
    for row in range(3):
        head = foxglove_header(100 + row / 10, "other")
        log.add("/other/depth", RAW, {**head, **raw_image(depth_values(row + 50), "16UC1")}, CDR)
        log.add("/other/camera_info", CALIBRATION, {**head, **calibration(WIDTH, HEIGHT, 20, 20, 4, 3)}, CDR)
    colour = raw_image(np.zeros((HEIGHT, WIDTH, 3), np.uint8), "rgb8")
    log.add(COLOUR, RAW, {**foxglove_header(100, OPTICAL), **colour}, CDR)
    path = log.write(tmp_path / "log.mcap")
    found = check_reader(McapReader(), path)
    assert len(found.frames) == 2 and found.frames[0].camera.fx == 10, "the depth on a colour image's grid"
    assert f"depth of {DEPTH} taken, not of /other/depth: see option depth_topic" in found.notes
    other = check_reader(McapReader(depth_topic="/other/depth"), path)
    assert len(other.frames) == 3 and other.frames[0].camera.fx == 20, "the calibration beside the images"
    mixed = McapReader(depth_topic="other/depth", calibration_topic=INFO).open(path)
    assert mixed.frames[0].camera.fx == 10
    with pytest.raises(SourceError, match="no messages on /gone: there are /cam/depth/image, /other/depth"):
        McapReader(depth_topic="/gone").open(path)
    with pytest.raises(SourceError, match="no points in it"):
        McapReader(frames="points").open(path)


def test_infrared_of_16_bits_is_no_depth_where_there_is_some(tmp_path: Path) -> None:
    log = depth_log(some_images(2))
    for row in range(3):
        log.add(
            "/cam/ir", RAW, {**foxglove_header(100 + row / 10, OPTICAL), **raw_image(depth_values(row), "mono16")}, CDR
        )
    notes = McapReader().open(log.write(tmp_path / "log.mcap")).notes
    assert f"depth of {DEPTH} taken, not of /cam/ir: see option depth_topic" in notes


def test_an_uncalibrated_camera_is_said_to_be_one(tmp_path: Path) -> None:
    log = depth_log(some_images())
    zero = {**foxglove_header(100, OPTICAL), **calibration(WIDTH, HEIGHT, 0, 0, 0, 0)}
    log.messages = [message for message in log.messages if message[0] != INFO]
    log.add(INFO, CALIBRATION, zero, CDR)
    with pytest.raises(SourceError, match=r"/cam/depth/camera_info: 1 left out: .*matrix K.*: give --set .*camera="):
        McapReader().open(log.write(tmp_path / "zero.mcap"))


def test_calibrations_that_do_not_fit(tmp_path: Path) -> None:
    log = Log()
    for row in range(2):
        log.add(DEPTH, RAW, {**foxglove_header(100 + row, OPTICAL), **some_images(1)[0]}, CDR)
    with pytest.raises(SourceError, match=r"no calibration for /cam/depth/image: give --set .*camera="):
        McapReader().open(log.write(tmp_path / "none.mcap"))
    by_option = check_reader(McapReader(camera=(9, 9, 4, 3)), tmp_path / "none.mcap")
    assert by_option.frames[0].camera == Camera(WIDTH, HEIGHT, 9, 9, 4, 3)
    half = calibration(2 * WIDTH, 2 * HEIGHT, 20, 20, 8.5, 6.5)
    log.add(INFO, CALIBRATION, {**foxglove_header(100, OPTICAL), **half}, CDR)
    scaled = McapReader().open(log.write(tmp_path / "half.mcap"))
    assert scaled.frames[0].camera == Camera(WIDTH, HEIGHT, 10, 10, 4, 3)
    assert f"{INFO}: intrinsics of {2 * WIDTH}x{2 * HEIGHT} are scaled to the images' {WIDTH}x{HEIGHT}" in scaled.notes


@pytest.mark.parametrize(
    ("info", "frame", "doubted"), [(INFO, "other", 0), ("/b/info", OPTICAL, 0), ("/b/info", "other", 1)]
)
def test_the_calibration_of_another_camera_is_a_doubt(tmp_path: Path, info: str, frame: str, doubted: int) -> None:
    log = Log()
    log.add(info, CALIBRATION, {**foxglove_header(100, frame), **calibration(WIDTH, HEIGHT, 9, 9, 4, 3)}, CDR)
    log.add(DEPTH, RAW, {**foxglove_header(100, OPTICAL), **some_images(1)[0]}, CDR)
    source = McapReader().open(log.write(tmp_path / "log.mcap"))
    assert source.frames[0].camera == Camera(WIDTH, HEIGHT, 9, 9, 4, 3)
    told = f"{DEPTH} is of {OPTICAL}, and its intrinsics are from {info}, of {frame}: "
    assert [str(doubt).startswith(told) for doubt in source.doubts] == [True] * doubted


@pytest.mark.parametrize("height", [400, 0])
def test_calibrations_of_another_shape_are_named(tmp_path: Path, height: int) -> None:
    log = Log()
    log.add(DEPTH, RAW, {**foxglove_header(100, OPTICAL), **some_images(1)[0]}, CDR)
    log.add(INFO, CALIBRATION, {**foxglove_header(100, OPTICAL), **calibration(640, height, 500, 500, 320, 200)}, CDR)
    with pytest.raises(
        SourceError, match=f"no calibration .*8x6 images of {DEPTH}: there is {INFO} 640x{height}: give"
    ):
        McapReader().open(log.write(tmp_path / "size.mcap"))
    with pytest.raises(
        SourceError,
        match=f"calibrates 640x{height} images, those of /cam/depth/image are 8x6: give --set source.reader.camera=",
    ):
        McapReader(calibration_topic=INFO).open(tmp_path / "size.mcap")


def test_the_rectified_image_has_the_projection_of_p(tmp_path: Path) -> None:
    info = calibration(WIDTH, HEIGHT, 10, 10, 4, 3)
    info.update(D=[0.1, 0, 0, 0, 0], P=[12, 0, 4.5, 0, 0, 13, 3.5, 0, 0, 0, 1, 0])
    for topic, focal in (("/cam/image_rect", (12, 13)), ("/cam/image_raw", (10, 10))):
        log = Log()
        log.add(topic, RAW, {**foxglove_header(100, OPTICAL), **some_images(1)[0]}, JSON)
        log.add("/cam/camera_info", CALIBRATION, {**foxglove_header(100, OPTICAL), **info}, JSON)
        source = McapReader().open(log.write(tmp_path / "log.mcap"))
        assert (source.frames[0].camera.fx, source.frames[0].camera.fy) == focal
        assert any("lens distortion" in note for note in source.notes) == ("raw" in topic)


@pytest.mark.parametrize(("model", "more"), [("plumb_bob", []), ("rational_polynomial", [0.1, 0.05, 0.0])])
def test_what_the_lens_bent_is_straight(tmp_path: Path, model: str, more: list[float]) -> None:
    camera, d = Camera(128, 96, 50, 50, 63.5, 47.5), [-0.2, 0.05, 0.005, -0.005, 0.0, *more]
    ray = np.array([[[-0.9, -0.7, 1.0]]])
    u, v = np.round(cv2.projectPoints(ray, np.zeros(3), np.zeros(3), camera.matrix, np.array(d))[0].ravel()).astype(int)
    meant = (camera.matrix @ ray.ravel())[:2]
    assert np.hypot(u - meant[0], v - meant[1]) > 5
    seen = np.zeros((96, 128), np.uint16)
    seen[v - 1 : v + 2, u - 1 : u + 2] = 2000
    bright = np.where(seen[..., None], 255, 0).repeat(3, axis=2).astype(np.uint8)
    head, log = foxglove_header(100, OPTICAL), Log()
    log.add(DEPTH, COMPRESSED, {**head, **compressed_depth(seen, "png")}, CDR)
    log.add(COLOUR, RAW, {**head, **raw_image(bright, "rgb8")}, CDR)
    info = {**calibration(128, 96, 50, 50, 63.5, 47.5), "D": d, "distortion_model": model}
    log.add(INFO, CALIBRATION, {**head, **info}, CDR)
    (frame,) = check_reader(McapReader(), log.write(tmp_path / "log.mcap")).frames
    (bent,) = McapReader(undistort=False).open(tmp_path / "log.mcap").frames
    assert frame.read_depth and frame.read_colour and frame.encoded_depth and bent.read_depth
    for image in (frame.read_depth(), frame.read_colour()[..., 0] > 200):
        rows, columns = np.nonzero(image)
        np.testing.assert_allclose([columns.mean(), rows.mean()], meant, atol=1.0)
    coded = cv2.imdecode(np.frombuffer(frame.encoded_depth().contents, np.uint8), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(coded, stored(frame, 1000))
    np.testing.assert_array_equal(stored(bent, 1000), seen)
    (alone,) = McapReader(frames="colour").open(tmp_path / "log.mcap").frames
    assert alone.read_colour
    np.testing.assert_array_equal(alone.read_colour(), frame.read_colour())


def test_stamps_that_mean_nothing(tmp_path: Path) -> None:
    log = Log()
    for row in range(3):
        for topic, stamp in (("/unset", 0), ("/same", 7)):
            head = foxglove_header(stamp, OPTICAL)
            log.add(topic, RAW, {**head, **some_images(1)[0]}, CDR, log_ns=(row + 50) * SECOND)
    path = log.write(tmp_path / "log.mcap")
    for topic, note in (("/unset", "without a stamp: their log time is taken"), ("/same", "log time is taken")):
        source = check_reader(McapReader(depth_topic=topic, camera=(10, 10, 4, 3)), path)
        assert [frame.stamp_s for frame in source.frames] == [50.0, 51.0, 52.0]
        assert any(topic in line and note in line for line in source.notes)


def test_frames_in_order_once_each_and_every_nth(tmp_path: Path) -> None:
    log = Log()
    for stamp in (103, 101, 102, 101, 104):
        log.add(DEPTH, RAW, {**foxglove_header(stamp, OPTICAL), **raw_image(depth_values(stamp), "16UC1")}, CDR)
    path = log.write(tmp_path / "log.mcap")
    source = check_reader(McapReader(camera=(10, 10, 4, 3)), path)
    assert [frame.stamp_s for frame in source.frames] == [101.0, 102.0, 103.0, 104.0]
    assert np.array_equal(source.frames[0].read_depth(), depth_values(101).astype(np.float32) * np.float32(1e-3))
    assert f"{DEPTH}: 1 message with the stamp of an earlier one left out" in source.notes
    thinned = McapReader(camera=(10, 10, 4, 3), every=3).open(path)
    assert [(frame.frame_id, frame.stamp_s) for frame in thinned.frames] == [(0, 101.0), (3, 104.0)]


def test_messages_stay_in_the_order_of_the_recording_where_its_clock_jumps_back(tmp_path: Path) -> None:
    stamps_s = np.concatenate([100 + 0.1 * np.arange(15), 99.5 + 0.1 * np.arange(15)]).round(6)
    log = Log()
    for row, stamp in enumerate(stamps_s.tolist()):
        head, grey = foxglove_header(stamp, OPTICAL), np.full((HEIGHT, WIDTH, 3), row, np.uint8)
        log.add(DEPTH, RAW, {**head, **raw_image(depth_values(row), "16UC1")}, CDR, log_ns=int(stamp * SECOND))
        log.add(COLOUR, RAW, {**head, **raw_image(grey, "rgb8")}, CDR, log_ns=int(stamp * SECOND))
    source = McapReader(camera=(10, 10, 4, 3)).open(log.write(tmp_path / "log.mcap"))
    assert [frame.stamp_s for frame in source.frames] == pytest.approx(stamps_s)
    assert f"{DEPTH}: the clock jumps back 1 time: messages are taken in the order of the recording" in source.notes
    colours = [frame.read_colour() for frame in source.frames if frame.read_colour is not None]
    assert [int(image.max()) for image in colours] == list(range(30))  # not those of the same stamp before the jump


def test_colour_that_is_of_another_clock_is_a_doubt(tmp_path: Path) -> None:
    doubts = {}
    for late_s in (0.0, 5.0):
        log = depth_log(some_images(3))
        for row in range(3):
            head = foxglove_header(100 + row / 10 + late_s, OPTICAL)
            log.add(COLOUR, RAW, {**head, **raw_image(np.zeros((HEIGHT, WIDTH, 3), np.uint8), "rgb8")}, CDR)
        doubts[late_s] = McapReader().open(log.write(tmp_path / "log.mcap")).doubts
    assert not doubts[0.0]
    assert [(note.kind, note.count, note.detail) for note in doubts[5.0]] == [("colour unpaired", 3, "3")]


def test_a_recording_that_breaks_off_is_named(tmp_path: Path) -> None:
    path = write_depth_log(tmp_path / "log.mcap", some_images(9), chunk_size=400)
    assert not McapReader().open(path).doubts
    path.write_bytes(path.read_bytes()[: path.read_bytes().rfind(b"/cam/depth/image") // 2])
    (doubt,) = McapReader().open(path).doubts
    assert doubt.kind == "recording incomplete" and str(doubt).startswith("1 file of the recording is cut off")
