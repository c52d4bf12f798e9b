from __future__ import annotations

import struct
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hodge_adapters.mcap.fields import pose_values
from hodge_adapters.mcap.images import decode_rvl
from hodge_adapters.mcap.protobuf import protobuf_decoder
from hodge_adapters.mcap.reader import McapReader
from hodge_adapters.mcap.records import Malformed
from hodge_adapters.mcap.ros_cdr import ros_decoder
from hodge_adapters.mcap.ros_tf import TransformTree
from hodge_adapters.mcap.writer import McapWriter
from hodge_pipeline import se3
from hodge_pipeline.testing import check_reader
from hodge_pipeline.types import PointCloud, Trajectory
from mcap_data import Log, foxglove_header, odometry, point_cloud, pose_message, ros_header
from mcap_encoding import (
    CDR,
    JSON,
    PROTOBUF,
    ROS_SCHEMAS,
    descriptor_set,
    encode_cdr,
    encode_protobuf,
    encode_rvl,
    pack_nibbles,
)
from readers_data import some_poses

CLOUD = "sensor_msgs/msg/PointCloud2"


def test_cdr_by_hand() -> None:
    text = """# comment
uint8 FIRST=1
string NAME = "x # y"
bool flag
float64 number 1.5
string<=8 name "abc"
int16[2] pair
uint8[] bytes
uint16[<=3] words
Inner[] inner
builtin_interfaces/Time stamp
================================================================================
MSG: pkg/Inner
int8 a
string[] texts
"""
    body = b"\1" + bytes(7) + struct.pack("<d", 2.5)  # A double starts at a multiple of eight.
    body += struct.pack("<I", 3) + b"ab\0" + b"\0" + struct.pack("<hh", -1, 2) + struct.pack("<I", 3) + b"xyz" + b"\0"
    body += struct.pack("<I", 1) + struct.pack("<H", 9) + b"\0\0"
    body += struct.pack("<I", 1) + b"\xfe" + bytes(3) + struct.pack("<II", 1, 2) + b"t\0" + bytes(2)
    body += struct.pack("<iI", 5, 6)
    data = b"\0\1\0\0" + body
    message = ros_decoder("pkg/msg/Outer", text)(data)
    assert message["flag"] is True and message["number"] == 2.5 and message["name"] == "ab"
    assert message["pair"].tolist() == [-1, 2] and message["words"].tolist() == [9]
    assert data[message["bytes"]] == b"xyz"
    assert message["inner"] == [{"a": -2, "texts": ["t"]}]
    assert message["stamp"] == {"sec": 5, "nanosec": 6}
    assert "FIRST" not in message and "NAME" not in message


@given(cut=st.integers(0, 400))
@settings(deadline=None)
def test_cdr_that_is_cut_is_refused(cut: int) -> None:
    name = "nav_msgs/msg/Odometry"
    for big_endian in (False, True):
        whole = encode_cdr(name, odometry(12.5, some_poses(1)[0]), big_endian)
        decode = ros_decoder(name, ROS_SCHEMAS[name])
        decoded = decode(whole)
        assert decoded["header"]["stamp"] == {"sec": 12, "nanosec": 500_000_000}
        assert decoded["child_frame_id"] == "base_link" and len(decoded["pose"]["covariance"]) == 36
        if cut < len(whole):
            with pytest.raises(Malformed):
                decode(whole[:cut])


@pytest.mark.parametrize("text", ["Gone gone", "pkg/Gone[] gone"])
def test_a_schema_that_is_not_whole(text: str) -> None:
    with pytest.raises(Malformed, match="does not define pkg/Gone"):
        ros_decoder("pkg/msg/Outer", text)


def test_schemas_that_never_end() -> None:
    with pytest.raises(Malformed, match="too deep"):
        ros_decoder("pkg/msg/Loop", "Loop again")(b"\0\1\0\0" + bytes(100))
    # A count of four billion empty messages in a few bytes.
    text = f"Empty[] empties\n{'=' * 80}\nMSG: pkg/Empty\n"
    with pytest.raises(Malformed, match="shorter"):
        ros_decoder("pkg/msg/Outer", text)(b"\0\1\0\0\xff\xff\xff\xff" + bytes(100))


def test_protobuf_by_hand() -> None:
    message = {"timestamp": {"sec": 3, "nsec": 7}, "frame_id": "é", "data": b"\1\2", "format": "png"}
    data = encode_protobuf("foxglove.CompressedImage", message)
    unknown = b"\xf8\x3f\x05" + b"\xf9\x3f" + bytes(8) + b"\xfd\x3f" + bytes(4) + b"\xfa\x3f\x01x"
    decoded = protobuf_decoder("foxglove.CompressedImage", descriptor_set())(unknown + data)
    assert decoded["timestamp"] == {"seconds": 3, "nanos": 7} and decoded["frame_id"] == "é"
    assert (unknown + data)[decoded["data"]] == b"\1\2"
    with pytest.raises(Malformed, match=r"does not define foxglove\.Gone"):
        protobuf_decoder("foxglove.Gone", descriptor_set())


@given(data=st.binary(max_size=64), name=st.sampled_from(["foxglove.PointCloud", "foxglove.CameraCalibration"]))
@settings(deadline=None)
def test_any_bytes_as_protobuf_or_cdr(data: bytes, name: str) -> None:
    for decode in (protobuf_decoder(name, descriptor_set()), ros_decoder(CLOUD, ROS_SCHEMAS[CLOUD])):
        with suppress(Malformed):
            assert isinstance(decode(data), dict)


@given(
    st.lists(st.one_of(st.just(0), st.integers(1, 65535), st.integers(1000, 1010)), min_size=1, max_size=200),
)
@settings(deadline=None)
def test_rvl_round_trip(pixels: list[int]) -> None:
    image = np.array(pixels, np.uint16)
    assert np.array_equal(decode_rvl(encode_rvl(image), len(image)), image)


def test_rvl_by_hand() -> None:
    # Two zeros, then three pixels: 5, 5 + 1, 6 - 2; zigzag makes 10, 2, 3 of them; 10 needs two nibbles.
    code = bytes.fromhex("0023a123")
    assert code == pack_nibbles([2, 3, 10, 2, 3])
    assert decode_rvl(code, 5).tolist() == [0, 0, 5, 6, 4]


@pytest.mark.parametrize(
    "numbers",
    [
        [],
        [1],
        [4, 0],  # too few pixels
        [2**31, 5],
        [0, 2**31],
        [0, 6, 2, 2, 2, 2, 2, 2],  # past the image
        [0, 5, 1, 2, 2, 2, 2],  # a depth below zero
        [0, 5, 2**18, 2, 2, 2, 2],  # a depth of more than 16 bits
    ],
)
def test_rvl_that_lies(numbers: list[int]) -> None:
    with pytest.raises(Malformed):
        decode_rvl(pack_nibbles([0, 40, 2, 2]), 40)
    with pytest.raises(Malformed):
        decode_rvl(pack_nibbles(numbers), 5)


@given(data=st.binary(max_size=64), pixels=st.integers(1, 100))
@settings(deadline=None)
def test_any_bytes_as_rvl(data: bytes, pixels: int) -> None:
    with suppress(Malformed):
        assert decode_rvl(data, pixels).shape == (pixels,)


def read_cloud(tmp_path: Path, schema: str, message: dict, encoding: str = CDR) -> PointCloud:
    log = Log()
    log.add("/points", schema, message, encoding)
    return check_reader(McapReader(), log.write(tmp_path / "log.mcap")).frames[0].read_points()


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("kind", ["f4", "f8"])
def test_points_by_their_fields(tmp_path: Path, order: str, kind: str) -> None:
    points = np.random.default_rng(0).normal(0, 2, (12, 3)).astype(np.float32)
    points[5, 1], points[7, 2] = np.nan, np.inf
    packed = np.array([(10 << 16 | 20 << 8 | n) for n in range(12)], np.uint32).view(np.float32)
    columns = {axis: points[:, i].astype(order + kind) for i, axis in enumerate("xyz")}
    columns["intensity"] = np.zeros(12, order + "u2")
    columns["rgb"] = packed.astype(order + "f4") if order == "<" else packed.view("u4").astype(">u4").view(">f4")
    size = int(kind[1])
    offsets = {"x": 2 * size + 3, "z": 1, "y": size + 2, "intensity": 3 * size + 3, "rgb": 3 * size + 6}
    cloud = point_cloud(columns, offsets, 40, height=3, pad=9)
    read = read_cloud(tmp_path, CLOUD, {"header": ros_header(5, "lidar"), **cloud})
    good = [n for n in range(12) if n not in (5, 7)]
    assert np.array_equal(read.points_in_cam, points[good])
    assert read.colours.tolist() == [[10, 20, n] for n in good] and read.normals_in_cam is None


def test_normals_of_points(tmp_path: Path) -> None:
    names = ("x", "y", "z", "normal_x", "normal_y", "normal_z")
    values = np.random.default_rng(0).normal(0, 2, (4, 6)).astype("<f4")
    values[1, 3:] = 0
    cloud = point_cloud(
        {name: values[:, i] for i, name in enumerate(names)}, {n: 4 * i for i, n in enumerate(names)}, 24
    )
    normals = read_cloud(tmp_path, CLOUD, {"header": ros_header(5, "lidar"), **cloud}).normals_in_cam
    assert np.linalg.norm(normals, axis=1) == pytest.approx([1, 0, 1, 1])


@pytest.mark.parametrize("encoding", [PROTOBUF, JSON])
def test_foxglove_points_are_moved_by_their_pose(tmp_path: Path, encoding: str) -> None:
    points = np.random.default_rng(0).normal(0, 2, (5, 3)).astype("<f4")
    fields = [{"name": axis, "offset": 4 * i, "type": 7} for i, axis in enumerate("xyz")]
    message = {**foxglove_header(5, "lidar"), "point_stride": 12, "fields": fields, "data": points.tobytes()}
    assert np.array_equal(read_cloud(tmp_path, "foxglove.PointCloud", message, encoding).points_in_cam, points)
    pose = some_poses(1)[0]
    message["pose"] = pose_message(pose)
    moved = read_cloud(tmp_path, "foxglove.PointCloud", message, encoding).points_in_cam
    np.testing.assert_allclose(moved, se3.transform(pose, points), atol=1e-6)


def test_an_empty_cloud(tmp_path: Path) -> None:
    offsets = {"x": 0, "y": 4, "z": 8}
    cloud = point_cloud({axis: np.zeros(1, "<f4") for axis in "xyz"}, offsets, 12)
    cloud.update(width=0, row_step=0, data=b"")
    assert len(read_cloud(tmp_path, CLOUD, {"header": ros_header(5, "lidar"), **cloud})) == 0


def test_transforms_between_branches() -> None:
    """world -> a -> b and world -> c: from b to c by way of world.

    world
     |- a (moves) - b (fixed)
     `- c (fixed)
    """
    tree = TransformTree(max_gap_s=1.0)
    a0, a1, b, c = some_poses(4)

    def values(pose: np.ndarray) -> tuple[float, ...]:
        return (*pose[:3, 3], *se3.to_quat_xyzw(pose))

    tree.add("world", "a", 1.0, values(a1), is_static=False)
    tree.add("world", "a", 0.0, values(a0), is_static=False)
    tree.add("a", "b", 77.0, values(b), is_static=True)
    tree.add("world", "c", 99.0, values(c), is_static=False)
    tree.add("b", "c", 99.0, values(c), is_static=False)
    assert tree.other_parents == 1 and tree.root("b") == "world" and "d" not in tree
    found = tree.lookup("c", "b", np.array([0.0, 0.25, 3.0]))
    np.testing.assert_allclose(found[0], se3.inverse(c) @ a0 @ b, atol=1e-12)
    np.testing.assert_allclose(found[1], se3.inverse(c) @ se3.interpolate(a0, a1, np.array(0.25)) @ b, atol=1e-12)
    assert np.isnan(found[2]).any()
    assert tree.lookup("d", "b", np.zeros(1)) is None
    assert tree.moving_stamps("c", "b").tolist() == [0.0, 1.0]


def test_transforms_in_a_ring_end() -> None:
    tree = TransformTree(max_gap_s=1.0)
    for parent, child in (("a", "b"), ("b", "c"), ("c", "a")):
        tree.add(parent, child, 0.0, (1, 0, 0, 0, 0, 0, 1), is_static=True)
    assert tree.root("a") == "b" and se3.is_motion(tree.lookup("a", "c", np.zeros(1))).all()


@pytest.mark.parametrize(("kind", "far"), [("<f8", 5_400_000.123), ("<f8", 12.5), ("<f4", 5_400_000.0)])
def test_points_that_are_rounded_far_from_zero_are_told(tmp_path: Path, kind: str, far: float) -> None:
    columns = {axis: np.array([far, far + 0.1, np.nan], kind) for axis in "xyz"}
    size = np.dtype(kind).itemsize
    log = Log()
    cloud = point_cloud(columns, {"x": 0, "y": size, "z": 2 * size}, 3 * size)
    log.add("/points", CLOUD, {"header": ros_header(100, "cam"), **cloud}, CDR)
    source = McapReader().open(log.write(tmp_path / "a.mcap"))
    told = any("/points: its points lie far from zero and are rounded" in note for note in source.notes)
    assert told == (far > 1e6)
    written = McapWriter().write(
        tmp_path / "out.mcap", replace(source, trajectory=Trajectory(np.array([100.0]), np.eye(4)[None]))
    )
    assert "1 point that is not finite left out" in written


@pytest.mark.parametrize("x", [1e101, float("nan"), float("inf")])
def test_a_pose_of_numbers_that_overflow_is_malformed(x: float) -> None:
    with pytest.raises(Malformed, match="no rigid motion"):
        pose_values({"x": x, "y": 0.0, "z": 0.0}, {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0})
