"""The messages of Livox's own drivers, CustomMsg: points with times, as ROS 1 and ROS 2 write them."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from mcap.writer import Writer

from hodge_adapters.mcap.reader import McapReader
from hodge_adapters.mcap.ros_definitions import definition
from hodge_pipeline.errors import SourceError
from hodge_pipeline.testing import check_reader

NAME = "livox_ros_driver2/msg/CustomMsg"
POINTS = np.random.default_rng(0).uniform(-9, 9, (5, 3)).astype(np.float32)
OFFSETS_NS = np.arange(5) * 25_000_000
CUT = "a message that is shorter than its fields say"


def cdr(order: str, count: int) -> bytes:
    """Each point at a multiple of four bytes; nothing follows the last."""
    out = bytearray([0, order == "<", 0, 0]) + struct.pack(f"{order}iII", 100, 0, 6) + b"livox\0" + bytes(6)
    out += struct.pack(f"{order}QIBBBBI", 100 * 10**9, count, 1, 0, 0, 0, count)
    rows = zip(OFFSETS_NS, POINTS, strict=True)
    return bytes(out) + b"\0".join(struct.pack(f"{order}I3fBBB", after, *point, 9, 0, 2) for after, point in rows)


def ros1() -> bytes:
    """No gaps at all."""
    out = struct.pack("<IIII", 0, 100, 0, 5) + b"livox" + struct.pack("<QIBBBBI", 100 * 10**9, 5, 1, 0, 0, 0, 5)
    rows = zip(OFFSETS_NS, POINTS, strict=True)
    return out + b"".join(struct.pack("<I3fBBB", after, *point, 9, 0, 2) for after, point in rows)


def recorded(path: Path, data: bytes, encoding: str = "cdr", schema: str = definition(NAME)) -> Path:
    with open(path, "wb") as stream:
        writer = Writer(stream)
        writer.start()
        kind = writer.register_schema(NAME, "ros1msg" if encoding == "ros1" else "ros2msg", schema.encode())
        channel = writer.register_channel("/livox/lidar", encoding, kind)
        for row in range(2):
            writer.add_message(
                channel, row * 10**8, data.replace(struct.pack("<I", 100), struct.pack("<I", 100 + row), 1), 0
            )
        writer.finish()
    return path


@pytest.mark.parametrize("kind", ["cdr", "cdr of a big-endian machine", "ros1"])
def test_points_come_with_their_times(tmp_path: Path, kind: str) -> None:
    if kind == "ros1":
        stamp, ros1_stamp = "builtin_interfaces/Time stamp", "uint32 seq\ntime stamp"
        path = recorded(tmp_path / "log.mcap", ros1(), "ros1", definition(NAME).replace(stamp, ros1_stamp))
    else:
        path = recorded(tmp_path / "log.mcap", cdr("<" if kind == "cdr" else ">", 5))
    source = check_reader(McapReader(), path)
    assert source.frames[0].stamp_s == 100 and source.frames[0].read_points is not None
    cloud = source.frames[0].read_points()
    np.testing.assert_array_equal(cloud.points_in_cam, POINTS)
    assert cloud.times_s is not None
    np.testing.assert_allclose(cloud.times_s, OFFSETS_NS * 1e-9, atol=1e-9)


def test_other_points_of_that_name_and_cut_messages_are_refused(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="no points as Livox's drivers write them"):
        McapReader().open(
            recorded(tmp_path / "a.mcap", cdr("<", 4), schema=definition(NAME).replace("uint32 off", "uint64 off"))
        )
    with pytest.raises(SourceError, match=CUT):
        McapReader().open(recorded(tmp_path / "b.mcap", cdr("<", 6)))
