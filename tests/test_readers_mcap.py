from __future__ import annotations

import itertools
import pickle
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from mcap.writer import CompressionType, IndexType

from hodge_adapters.mcap import McapReader
from hodge_adapters.seven_scenes import SevenScenesReader
from hodge_adapters.tum import TumReader
from hodge_pipeline import se3
from hodge_pipeline.errors import SourceError
from hodge_pipeline.testing import check_reader
from hodge_pipeline.types import Camera, Floats, Frame
from mcap_data import (
    CDR,
    ENCODINGS,
    JSON,
    PROTOBUF,
    SECOND,
    Log,
    calibration,
    compressed_depth,
    compressed_inverse_depth,
    foxglove_header,
    odometry,
    png,
    pose_message,
    raw_image,
    ros_header,
    transforms,
)
from readers_data import HEIGHT, WIDTH, depth_values, some_poses
from synthetic import tiny_sequence  # noqa: F401

RAW, COMPRESSED, CALIBRATION = "foxglove.RawImage", "foxglove.CompressedImage", "foxglove.CameraCalibration"
DEPTH, COLOUR, INFO = "/cam/depth/image", "/cam/color/image", "/cam/depth/camera_info"
OPTICAL = "cam_optical"
CAMERA = Camera(WIDTH, HEIGHT, 10, 11, 4, 3)


def write_depth_log(
    path: Path,
    images: list[dict[str, Any]],
    schema: str = RAW,
    encoding: str = CDR,
    camera: Camera = CAMERA,
    **options: Any,
) -> Path:
    """A recording of these depth images, ten a second from 100 s, with their calibration."""
    return depth_log(images, schema, encoding, camera).write(path, **options)


def depth_log(images: list[dict[str, Any]], schema: str = RAW, encoding: str = CDR, camera: Camera = CAMERA) -> Log:
    log = Log()
    for row, image in enumerate(images):
        head = foxglove_header(100 + row / 10, OPTICAL)
        info = calibration(camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
        log.add(INFO, CALIBRATION, {**head, **info}, encoding, log_ns=(100 + row) * SECOND)
        log.add(DEPTH, schema, {**head, **image}, encoding, log_ns=(100 + row) * SECOND)
    return log


def some_images(count: int = 3) -> list[dict[str, Any]]:
    return [raw_image(depth_values(row), "16UC1") for row in range(count)]


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
    folder = SevenScenesReader().open(data_dir / "seven_scenes/redkitchen").frames[:2]
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


@pytest.mark.parametrize("compression", list(CompressionType))
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"chunk_size": 1},
        {"use_chunking": False},
        {"index_types": IndexType.NONE, "use_statistics": False, "use_summary_offsets": False},
        {"repeat_channels": False, "repeat_schemas": False, "index_types": IndexType.NONE, "use_statistics": False},
        {"enable_crcs": False},
    ],
    ids=["default", "chunk for each message", "no chunks", "no index", "no summary", "no checksums"],
)
def test_every_kind_of_file(tmp_path: Path, compression: CompressionType, options: dict[str, Any]) -> None:
    path = write_depth_log(tmp_path / "log.mcap", some_images(), compression=compression, **options)
    source = check_reader(McapReader(), path)
    for row, frame in enumerate(source.frames):
        assert np.array_equal(frame.read_depth(), depth_values(row).astype(np.float32) * np.float32(1e-3))
    assert len(source.frames) == 3
    assert not any("left out" in note or "cut off" in note for note in source.notes)


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


def test_calibrations_that_do_not_fit(tmp_path: Path) -> None:
    log = Log()
    for row in range(2):
        log.add(DEPTH, RAW, {**foxglove_header(100 + row, OPTICAL), **some_images(1)[0]}, CDR)
    with pytest.raises(SourceError, match=r"no calibration for /cam/depth/image: give option camera"):
        McapReader().open(log.write(tmp_path / "none.mcap"))
    by_option = check_reader(McapReader(camera=(9, 9, 4, 3)), tmp_path / "none.mcap")
    assert by_option.frames[0].camera == Camera(WIDTH, HEIGHT, 9, 9, 4, 3)
    log.add(INFO, CALIBRATION, {**foxglove_header(100, OPTICAL), **calibration(640, 480, 500, 500, 320, 240)}, CDR)
    with pytest.raises(SourceError, match="no calibration"):
        McapReader().open(log.write(tmp_path / "size.mcap"))
    with pytest.raises(SourceError, match="calibrates 640x480 images, those of /cam/depth/image are 8x6"):
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


def camera_on_body() -> Floats:
    """The optical axes of a camera that looks along a body's x, 10 cm ahead: z ahead, x right, y down."""
    rotation = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    return se3.from_parts(rotation, np.array([0.1, 0, 0.2]))


def test_odometry_moved_to_the_optical_frame(tmp_path: Path) -> None:
    log, poses = depth_log(some_images(4)), some_poses(4)
    base_from_link = se3.from_parts(np.eye(3), np.array([0.0, 0.0, 0.3]))
    links = [(0.0, "link", OPTICAL, camera_on_body()), (0.0, "base_link", "link", base_from_link)]
    log.add("/tf_static", "tf2_msgs/msg/TFMessage", transforms(*links), CDR)
    for row, pose in enumerate(poses):
        log.add("/odom", "nav_msgs/msg/Odometry", odometry(100.05 + row / 10, pose), CDR)
    source = check_reader(McapReader(), log.write(tmp_path / "log.mcap"))
    base_from_cam = base_from_link @ camera_on_body()
    assert source.frames[0].world_from_cam is None, "before the first odometry"
    for row in (1, 2, 3):
        world_from_base = se3.interpolate(poses[row - 1], poses[row], np.array(0.5))
        np.testing.assert_allclose(source.frames[row].world_from_cam, world_from_base @ base_from_cam, atol=1e-6)
    np.testing.assert_allclose(source.trajectory.world_from_cam, poses @ base_from_cam, atol=1e-9)
    assert "1 of 4 frames have no pose within 0.2 s of their stamp" in source.notes


def test_odometry_of_a_body_that_nothing_links_to_the_camera(tmp_path: Path) -> None:
    log = depth_log(some_images(2))
    for row, pose in enumerate(some_poses(2)):
        log.add("/odom", "nav_msgs/msg/Odometry", odometry(100 + row / 10, pose), CDR)
    path = log.write(tmp_path / "log.mcap")
    source = check_reader(McapReader(), path)
    assert all(frame.world_from_cam is None for frame in source.frames) and len(source.trajectory) == 2
    assert any("no transform leads from base_link of /odom to cam_optical" in note for note in source.notes)
    told = check_reader(McapReader(pose_child=OPTICAL), path)
    np.testing.assert_allclose(told.frames[1].world_from_cam, some_poses(2)[1], atol=1e-9)


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_bare_poses_are_of_the_camera(tmp_path: Path, encoding: str) -> None:
    log, poses = depth_log(some_images(3), encoding=encoding), some_poses(3)
    for row, pose in enumerate(poses):
        head = foxglove_header(100 + row / 10, "map")
        log.add("/pose", "foxglove.PoseInFrame", {**head, "pose": pose_message(pose)}, encoding)
    source = check_reader(McapReader(), log.write(tmp_path / "log.mcap"))
    for frame, pose in zip(source.frames, poses, strict=True):
        np.testing.assert_allclose(frame.world_from_cam, pose, atol=1e-9)
    assert any("taken as poses of the camera itself" in note for note in source.notes)


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_transforms_in_time_are_interpolated_along_the_chain(tmp_path: Path, encoding: str) -> None:
    log, poses = depth_log(some_images(3), encoding=encoding), some_poses(4, seed=1)
    links = [(99.95 + row / 10, "odom", "base", pose) for row, pose in enumerate(poses)]
    map_from_odom = some_poses(1, seed=2)[0]
    fixed = [(5.0, "base", OPTICAL, camera_on_body()), (5.0, "map", "odom", map_from_odom)]
    if encoding == CDR:
        log.add("/tf_static", "tf2_msgs/msg/TFMessage", transforms(*fixed), CDR)
        for link in links:
            log.add("/tf", "tf2_msgs/msg/TFMessage", transforms(link), CDR)
    else:
        for seconds, parent, child, pose in [*links, *fixed]:
            head = foxglove_header(seconds, "")
            names = {"timestamp": head["timestamp"], "parent_frame_id": parent, "child_frame_id": child}
            motion = pose_message(pose)
            parts = {"translation": motion["position"], "rotation": motion["orientation"]}
            log.add("/tf", "foxglove.FrameTransform", {**names, **parts}, encoding)
    path = log.write(tmp_path / "log.mcap")
    in_map = check_reader(McapReader(), path)
    in_odom = check_reader(McapReader(world_frame="odom"), path)
    for row in range(3):
        odom_from_base = se3.interpolate(poses[row], poses[row + 1], np.array(0.5))
        expected = odom_from_base @ camera_on_body()
        np.testing.assert_allclose(in_odom.frames[row].world_from_cam, expected, atol=1e-6)
        np.testing.assert_allclose(in_map.frames[row].world_from_cam, map_from_odom @ expected, atol=1e-6)
    assert len(in_map.trajectory) == 4
    assert "poses of cam_optical in map from the transforms" in in_map.notes


def split_bag(folder: Path) -> list[bytes]:
    """Three files of one frame each, the transforms of all in the first."""
    for row in range(3):
        log = Log()
        if row == 0:
            log.add(
                INFO, CALIBRATION, {**foxglove_header(100, OPTICAL), **calibration(WIDTH, HEIGHT, 10, 11, 4, 3)}, CDR
            )
        log.add(DEPTH, RAW, {**foxglove_header(100 + row, OPTICAL), **some_images(3)[row]}, CDR)
        log.write(folder / f"bag_{row}.mcap")
    return [file.read_bytes() for file in sorted(folder.glob("*.mcap"))]


def metadata(*names: str) -> str:
    files = "".join(f"  - {name}\n" for name in names)
    return f"rosbag2_bagfile_information:\n  storage_identifier: mcap\n  relative_file_paths:\n{files}"


def test_a_split_bag(tmp_path: Path) -> None:
    split_bag(tmp_path)
    plain = check_reader(McapReader(), tmp_path)
    assert [frame.stamp_s for frame in plain.frames] == [100.0, 101.0, 102.0] and len(plain.files) == 3
    (tmp_path / "metadata.yaml").write_text(metadata("bag_0.mcap", "bag_2.mcap", "bag_9.mcap", "../../etc/passwd"))
    source = check_reader(McapReader(), tmp_path)
    assert len(source.frames) == 3 and tmp_path / "metadata.yaml" in source.files
    assert "metadata.yaml: 1 files that are not there left out: bag_9.mcap" in source.notes
    assert "metadata.yaml: 1 files outside of the folder left out" in source.notes
    assert "1 files that metadata.yaml does not list read as well: bag_1.mcap" in source.notes
    (tmp_path / "metadata.yaml").write_text("{broken: [")
    assert any("metadata.yaml cannot be read" in note for note in check_reader(McapReader(), tmp_path).notes)


@pytest.mark.parametrize(
    ("files", "remedy"),
    [
        ({}, "give the folder"),
        ({"bag_0.mcap.zstd": b""}, r"unpack bag_0\.mcap\.zstd first"),
        ({"bag_0.db3": b"SQLite"}, "ros2 bag convert"),
        ({"metadata.yaml": metadata("bag_0.mcap").encode()}, "lists no .mcap file that is there"),
        ({"a.mcap": b""}, "does not start as an MCAP file"),
        ({"a.mcap": b"#ROSBAG V2.0\n"}, "does not start as an MCAP file"),
    ],
)
def test_what_is_no_recording(tmp_path: Path, files: dict[str, bytes], remedy: str) -> None:
    for name, contents in files.items():
        (tmp_path / name).write_bytes(contents)
    with pytest.raises(SourceError, match=remedy) as raised:
        McapReader().open(tmp_path)
    assert str(tmp_path) in str(raised.value) and "\n" not in str(raised.value)


def test_a_recording_of_other_things_names_its_topics(tmp_path: Path) -> None:
    log = Log()
    log.add_bytes("/chatter", "std_msgs/msg/String", CDR, b"\0\1\0\0\5\0\0\0text\0")
    with pytest.raises(SourceError, match=r"no depth, clouds, images or poses in /chatter \(std_msgs/msg/String\)"):
        McapReader().open(log.write(tmp_path / "log.mcap"))


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
    assert f"{DEPTH}: 1 messages with the stamp of an earlier one left out" in source.notes
    thinned = McapReader(camera=(10, 10, 4, 3), every=3).open(path)
    assert [(frame.frame_id, frame.stamp_s) for frame in thinned.frames] == [(0, 101.0), (3, 104.0)]


def test_schemas_that_are_not_read_are_named(tmp_path: Path) -> None:
    log = depth_log(some_images(1))
    log.add_bytes("/idl", "sensor_msgs/msg/Image", "cbor", b"")
    source = check_reader(McapReader(), log.write(tmp_path / "log.mcap"))
    assert any(note.startswith("/idl: left out: cbor messages") for note in source.notes)


def test_a_pickled_frame_is_small_and_needs_no_schema(tmp_path: Path) -> None:
    path = write_depth_log(tmp_path / "log.mcap", some_images(1), encoding=PROTOBUF)
    frame = McapReader().open(path).frames[0]
    assert len(pickle.dumps(frame)) < 2000


def test_a_file_that_changed_after_it_was_opened(tmp_path: Path) -> None:
    path = write_depth_log(tmp_path / "log.mcap", some_images(2))
    frame = McapReader().open(path).frames[1]
    path.write_bytes(path.read_bytes()[:60])
    with pytest.raises(SourceError, match=r"log\.mcap: /cam/depth/image at 100\.1"):
        frame.read_depth()
    path.unlink()
    with pytest.raises(SourceError, match=r"log\.mcap: cannot be read"):
        frame.read_depth()


def test_odometry_of_a_real_robot(data_dir: Path) -> None:
    source = check_reader(McapReader(), data_dir / "mcap/evo_nav2_turtlebot/nav2_turtlebot.mcap")
    assert len(source.trajectory) == 2639 and not source.frames
    assert "poses of /odom taken, not of /amcl_pose: see option pose_topic" in source.notes
    assert any("the log's clock differs" in note for note in source.notes)
    amcl = McapReader(pose_topic="/amcl_pose").open(data_dir / "mcap/evo_nav2_turtlebot/nav2_turtlebot.mcap")
    # The localised and the dead-reckoned path of one robot are the same curve but for drift.
    lengths = [
        np.linalg.norm(np.diff(s.trajectory.world_from_cam[:, :3, 3], axis=0), axis=1).sum() for s in (source, amcl)
    ]
    assert len(amcl.trajectory) == 135 and abs(lengths[1] / lengths[0] - 1) < 0.2


def test_real_foxglove_images(data_dir: Path) -> None:
    source = check_reader(McapReader(), data_dir / "mcap/small_misc/custom-camera-model.mcap")
    assert len(source.frames) == 10 and source.frames[0].read_colour().shape == (360, 520, 3)
    assert any("'CylinderCameraModel' is no pinhole camera" in note for note in source.notes)
    assert any("log time is taken" in note for note in source.notes)


@pytest.mark.parametrize(
    "name",
    ["rosbag2_tests/wbag", "rosbag2_tests/talker", "rosbag2_tests/convert_a", "rosbag2_tests/convert_b",
     "rosbag2_tests/reindex_test_bags/multiple_files", "small_misc/example.mcap", "small_misc/example_logs.mcap"],
)  # fmt: skip
def test_real_bags_without_frames_or_poses(data_dir: Path, name: str) -> None:
    assert McapReader().sniff(data_dir / "mcap" / name).confidence >= 0.7
    with pytest.raises(SourceError, match="no depth, clouds, images or poses in"):
        McapReader().open(data_dir / "mcap" / name)


def test_ros_headers(tmp_path: Path) -> None:
    log = depth_log(some_images(1))
    image = {"header": ros_header(100, "/" + OPTICAL), **raw_image(np.full((HEIGHT, WIDTH, 3), 9, np.uint8), "rgb8")}
    log.add(COLOUR, "sensor_msgs/msg/Image", image, CDR)
    source = check_reader(McapReader(), log.write(tmp_path / "log.mcap"))
    assert (source.frames[0].read_colour() == 9).all(), "a leading slash of a frame is the same frame"
    assert not any("colour is off" in note for note in source.notes)
