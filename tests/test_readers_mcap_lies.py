"""Recordings that lie about sizes, types and numbers: refused or left out in one line, never believed."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import lz4.frame
import numpy as np
import pytest
import zstandard
from mcap.opcode import Opcode

from hodge_adapters.mcap.reader import McapReader
from hodge_adapters.mcap.records import MAGIC
from hodge_pipeline.errors import SourceError
from mcap_data import Log, compressed_depth, odometry, png, point_cloud, raw_image, read_all, resident_peak, ros_header
from mcap_encoding import CDR, JSON, encode_cdr
from readers_data import depth_values, some_poses

IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"


def chunk_file(path: Path, compression: bytes, data: bytes, uncompressed: int) -> Path:
    """A file with one chunk that says it expands to so many bytes."""
    body = struct.pack("<QQQII", 0, 0, uncompressed, 0, len(compression)) + compression
    body += struct.pack("<Q", len(data)) + data
    header = struct.pack("<BQII", Opcode.HEADER, 8, 0, 0)
    path.write_bytes(MAGIC + header + struct.pack("<BQ", Opcode.CHUNK, len(body)) + body)
    return path


def zeros_zstd(count: int) -> bytes:
    """The zstd frame of so many zeros, made block by block."""
    compressor = zstandard.ZstdCompressor().compressobj()
    block = bytes(1 << 20)
    return b"".join([*(compressor.compress(block) for _ in range(count >> 20)), compressor.flush()])


@pytest.mark.parametrize("compression", ["zstd", "lz4"])
@pytest.mark.parametrize("declared", [1 << 20, 1 << 40, 1 << 63, 0])
def test_a_chunk_is_never_expanded_past_what_it_says_or_the_limit(
    tmp_path: Path, compression: str, declared: int
) -> None:
    data = zeros_zstd(1 << 27) if compression == "zstd" else lz4.frame.compress(bytes(1 << 24))
    path = chunk_file(tmp_path / "bomb.mcap", compression.encode(), data, declared)
    before = resident_peak()
    with pytest.raises(SourceError, match=r"bomb\.mcap: holds no message"):
        McapReader().open(path)
    assert resident_peak() - before < 64e6


def test_a_frame_header_of_zstd_is_not_believed(tmp_path: Path) -> None:
    """A frame whose own header says 2^62 bytes, in a chunk that says 1000."""
    data = struct.pack("<IBQ", 0xFD2FB528, 0xE0, 1 << 62) + b"\1\0\0"
    with pytest.raises(SourceError, match=r"holds no message.*a chunk that zstd cannot expand"):
        McapReader().open(chunk_file(tmp_path / "bomb.mcap", b"zstd", data, 1000))


def test_an_unknown_compression_is_named(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match=r"a chunk compressed by 'brotli': only zstd, lz4 and none are known"):
        McapReader().open(chunk_file(tmp_path / "log.mcap", b"brotli", b"xyz", 3))


LIES = {
    "rows that are not there": {"height": 1000},
    "more pixels than a camera has": {"height": 1 << 20, "width": 1 << 20, "step": 1 << 21},
    "no pixels": {"width": 0},
    "a step shorter than a row": {"step": 3},
    "a step of four billion": {"step": 0xFFFFFFFF},
    "an encoding that nobody knows": {"encoding": "64FC9"},
}


@pytest.mark.parametrize("lie", LIES)
def test_images_that_lie_are_left_out_and_counted(tmp_path: Path, lie: str) -> None:
    log = Log()
    for row in range(4):
        image = raw_image(depth_values(row), "16UC1") | (LIES[lie] if row % 2 else {})
        log.add("/raw", IMAGE, {"header": ros_header(100 + row, "cam"), **image}, CDR)
    source = McapReader(camera=(9, 9, 4, 3)).open(log.write(tmp_path / "log.mcap"))
    assert [frame.stamp_s for frame in source.frames] == [100.0, 102.0]
    assert any(note.startswith("/raw: 2 left out: a message with") for note in source.notes)


def png_that_says(width: int, height: int) -> bytes:
    """A valid PNG whose header says another size, with its checksum right."""
    contents = bytearray(png(depth_values()))
    contents[16:24] = struct.pack(">II", width, height)
    contents[29:33] = struct.pack(">I", zlib.crc32(contents[12:29]))
    return bytes(contents)


@pytest.mark.parametrize(("width", "height"), [(1 << 31, 1 << 31), (0, 5), (60000, 60000)])
def test_a_png_bomb_is_left_out(tmp_path: Path, width: int, height: int) -> None:
    log = Log()
    contents = {"format": "16UC1; compressedDepth png", "data": bytes(12) + png_that_says(width, height)}
    for row, data in enumerate((contents, compressed_depth(depth_values()))):
        log.add("/depth", COMPRESSED, {"header": ros_header(100 + row, "cam"), **data}, CDR)
    source = McapReader(camera=(9, 9, 4, 3)).open(log.write(tmp_path / "log.mcap"))
    assert [frame.stamp_s for frame in source.frames] == [101.0] and not read_all(source)
    assert any(note.startswith("/depth: 1 left out") for note in source.notes)


def test_a_png_with_fewer_rows_than_it_says_is_refused_when_read(tmp_path: Path) -> None:
    log = Log()
    contents = {"format": "16UC1; compressedDepth png", "data": bytes(12) + png(depth_values())[:-20]}
    log.add("/depth", COMPRESSED, {"header": ros_header(100, "cam"), **contents}, CDR)
    source = McapReader(camera=(9, 9, 4, 3)).open(log.write(tmp_path / "log.mcap"))
    with pytest.raises(SourceError, match=r"log\.mcap: /depth at 100\.000000000 s: the image is truncated or damaged"):
        source.frames[0].read_depth()


def test_rvl_of_another_size_is_refused_when_read(tmp_path: Path) -> None:
    image = compressed_depth(depth_values(), "rvl")
    image["data"] = image["data"][:12] + struct.pack("<II", 8000, 8000) + image["data"][20:]
    log = Log()
    log.add("/depth", COMPRESSED, {"header": ros_header(100, "cam"), **image}, CDR)
    source = McapReader(camera=(9, 9, 4, 3)).open(log.write(tmp_path / "log.mcap"))
    with pytest.raises(SourceError, match=r"/depth at 100\.000000000 s: an RVL code that breaks off"):
        source.frames[0].read_depth()


CLOUD_LIES = {
    "points that are not there": {"width": 4000},
    "four billion points": {"width": 0xFFFFFFFF, "height": 0xFFFFFFFF},
    "points of no size": {"point_step": 0},
    "points of four billion bytes": {"point_step": 0xFFFFFFFF},
    "rows shorter than their points": {"row_step": 5},
    "a field past its point": {"fields": [{"name": a, "offset": 10, "datatype": 7, "count": 1} for a in "xyz"]},
    "a field of no type": {"fields": [{"name": a, "offset": 0, "datatype": 99, "count": 1} for a in "xyz"]},
    "one field twice": {"fields": [{"name": a, "offset": 0, "datatype": 7, "count": 1} for a in "xyzz"]},
    "no z": {"fields": [{"name": a, "offset": 0, "datatype": 7, "count": 1} for a in "xy"]},
}


@pytest.mark.parametrize("lie", CLOUD_LIES)
def test_clouds_that_lie_are_left_out_and_counted(tmp_path: Path, lie: str) -> None:
    log = Log()
    for row in range(2):
        points = {axis: np.arange(4, dtype="<f4") for axis in "xyz"}
        cloud = point_cloud(points, {"x": 0, "y": 4, "z": 8}, 12) | (CLOUD_LIES[lie] if row else {})
        log.add("/points", "sensor_msgs/msg/PointCloud2", {"header": ros_header(100 + row, "cam"), **cloud}, CDR)
    source = McapReader().open(log.write(tmp_path / "log.mcap"))
    assert len(source.frames) == 1 and len(source.frames[0].read_points()) == 4
    assert any(note.startswith("/points: 1 left out: a message with") for note in source.notes)


@pytest.mark.parametrize(
    "message",
    [b"", b"[]", b"null", b"{", b"[" * 5000, b'{"data": 5}', b'{"timestamp": 3, "data": ""}', b'{"width": "x"}',
     b'{"timestamp": {"sec": 1e999}, "data": ""}', b'{"data": "%%%", "format": "png"}', b"\xff\xfe"],
)  # fmt: skip
def test_json_that_is_something_else(tmp_path: Path, message: bytes) -> None:
    log = Log()
    for schema in ("foxglove.CompressedImage", "foxglove.RawImage", "foxglove.FrameTransform", "foxglove.PointCloud"):
        log.add_bytes(f"/{schema}", schema, JSON, message)
    with pytest.raises(SourceError, match=r"no depth, clouds, images or poses in .*1 left out: a message with"):
        McapReader().open(log.write(tmp_path / "log.mcap"))


@pytest.mark.parametrize("quaternion", [(0, 0, 0, 0), (9, 0, 0, 0), (float("nan"), 0, 0, 1)])
def test_poses_that_are_none_are_left_out(tmp_path: Path, quaternion: tuple[float, ...]) -> None:
    log = Log()
    for row in range(3):
        message = odometry(100 + row, some_poses(1)[0])
        if row == 1:
            message["pose"]["pose"]["orientation"] = dict(zip("xyzw", quaternion, strict=True))
        log.add("/odom", "nav_msgs/msg/Odometry", message, CDR)
    source = McapReader().open(log.write(tmp_path / "log.mcap"))
    assert source.trajectory.stamps_s.tolist() == [100.0, 102.0]
    assert "/odom: 1 left out: a message with a pose that is no rigid motion" in source.notes


def test_a_message_of_an_unknown_channel_is_counted(tmp_path: Path) -> None:
    name = "nav_msgs/msg/Odometry"
    data = encode_cdr(name, odometry(1, some_poses(1)[0]))
    body = struct.pack("<HIQQ", 77, 0, 0, 0) + data
    message = struct.pack("<BQ", Opcode.MESSAGE, len(body)) + body
    with pytest.raises(SourceError, match="a message of a channel that the file does not define"):
        McapReader().open(chunk_file(tmp_path / "log.mcap", b"", message, len(message)))
