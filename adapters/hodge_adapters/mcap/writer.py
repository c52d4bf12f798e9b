"""Poses and clouds as an MCAP file of ROS 2 messages: `/tf`, and `/points` in the frame that it moves."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import CompressionType, Writer
from pydantic import ConfigDict
from pydantic.dataclasses import dataclass

from hodge_adapters.mcap.ros_definitions import definition
from hodge_adapters.posed import left_out, trajectory_of, written
from hodge_adapters.text_rows import opened_atomically
from hodge_pipeline import se3
from hodge_pipeline.errors import SourceError
from hodge_pipeline.types import Floats, PointCloud, Source
from hodge_pipeline.types.text import counted

WORLD, CAMERA = "map", "camera"
TF, POINTS = ("/tf", "tf2_msgs/msg/TFMessage"), ("/points", "sensor_msgs/msg/PointCloud2")
POINT_FIELDS = {"<u4": 6, "<f4": 7, "<f8": 8}
"""The codes of `sensor_msgs/PointField`."""
LATEST_S = 2**31
"""ROS counts seconds in 32 bits, with a sign."""


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class McapWriter:
    """Writes poses as transforms from `camera` to `map`, clouds with colours and times as PointCloud2 in `camera`."""

    def write(self, path: Path, source: Source) -> tuple[str, ...]:
        """One file, atomically; stamps are kept to the nanosecond, as far as a double holds them."""
        trajectory = trajectory_of(source)
        frames = [frame for frame in source.frames if frame.read_points is not None]
        stamps_s = [*trajectory.stamps_s.tolist(), *(frame.stamp_s for frame in frames)]
        if not all(0 <= stamp < LATEST_S for stamp in stamps_s):
            raise SourceError(f"{source.path}: has stamps that ROS cannot hold, from 0 to {LATEST_S} s: shift them")
        with opened_atomically(path) as file:
            writer = Writer(file, compression=CompressionType.ZSTD)
            writer.start(profile="ros2", library="hodge-pipeline")
            channels = {}
            for topic, name in (TF, POINTS)[: 2 if frames else 1]:
                schema = writer.register_schema(name, "ros2msg", definition(name).encode())
                channels[topic] = writer.register_channel(topic, "cdr", schema)
            for stamp_s, pose in zip(trajectory.stamps_s.tolist(), trajectory.world_from_cam, strict=True):
                _add(writer, channels[TF[0]], stamp_s, _transform(stamp_s, pose))
            no_numbers = 0
            for frame in frames:
                assert frame.read_points is not None
                cloud = frame.read_points()
                no_numbers += cloud.no_numbers
                _add(writer, channels[POINTS[0]], frame.stamp_s, _cloud(frame.stamp_s, cloud))
            writer.finish()  # type: ignore[no-untyped-call]
        clouds = f", {counted(len(frames), 'cloud')} on {POINTS[0]}" if frames else ""
        what = f"{counted(len(trajectory), 'pose')} on {TF[0]}{clouds}"
        return (*written(what, source, {"stamps", "point clouds"}), *left_out(no_numbers))


def _add(writer: Writer, channel: int, stamp_s: float, message: _Cdr) -> None:
    time_ns = sum(part * unit for part, unit in zip(_stamp(stamp_s), (1_000_000_000, 1), strict=True))
    writer.add_message(channel, time_ns, bytes(message.data), time_ns)


def _stamp(stamp_s: float) -> tuple[int, int]:
    """Seconds and nanoseconds."""
    return divmod(round(stamp_s * 1e9), 1_000_000_000)


class _Cdr:
    """A message while it is written, little-endian; alignment counts from behind its head of four bytes."""

    def __init__(self) -> None:
        self.data = bytearray(b"\0\1\0\0")

    def numbers(self, code: str, *values: float) -> _Cdr:
        size = struct.calcsize(f"<{code}")
        self.data += bytes(-(len(self.data) - 4) % size) + struct.pack(f"<{len(values)}{code}", *values)
        return self

    def text(self, value: str) -> _Cdr:
        encoded = value.encode() + b"\0"
        self.numbers("I", len(encoded))
        self.data += encoded
        return self

    def header(self, stamp_s: float, frame: str) -> _Cdr:
        return self.numbers("I", *_stamp(stamp_s)).text(frame)


def _transform(stamp_s: float, pose: Floats) -> _Cdr:
    numbers = [*pose[:3, 3].tolist(), *se3.to_quat_xyzw(pose).tolist()]
    return _Cdr().numbers("I", 1).header(stamp_s, WORLD).text(CAMERA).numbers("d", *numbers)


def _cloud(stamp_s: float, cloud: PointCloud) -> _Cdr:
    fields: list[tuple[str, np.dtype[Any]]] = [(axis, np.dtype("<f4")) for axis in "xyz"]
    if cloud.colours is not None:
        fields.append(("rgb", np.dtype("<u4")))
    if cloud.times_s is not None:
        fields.append(("timestamp", np.dtype("<f8")))
    columns = np.zeros(len(cloud), fields)
    for number, axis in enumerate("xyz"):
        columns[axis] = cloud.points_in_cam[:, number]
    if cloud.colours is not None:
        red, green, blue = np.asarray(cloud.colours, np.uint32).T
        columns["rgb"] = red << 16 | green << 8 | blue
    if cloud.times_s is not None:
        columns["timestamp"] = cloud.first_s + cloud.times_s.astype(float)
    message = _Cdr().header(stamp_s, CAMERA).numbers("I", 1, len(cloud), len(fields))
    offset = 0
    for name, kind in fields:
        message.text(name).numbers("I", offset).numbers("B", POINT_FIELDS[kind.str]).numbers("I", 1)
        offset += kind.itemsize
    step = columns.itemsize
    message.numbers("B", 0).numbers("I", step, step * len(cloud), step * len(cloud))
    message.data += columns.tobytes()
    return message.numbers("B", int(np.isfinite(cloud.points_in_cam).all()))
