"""Small MCAP recordings made on the spot: the same frames as ROS 2 (CDR), Foxglove protobuf and Foxglove JSON."""

from __future__ import annotations

import json
import resource
import struct
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from mcap.writer import CompressionType, Writer

from hodge_pipeline import se3
from hodge_pipeline.errors import SourceError
from hodge_pipeline.types import Camera, Floats, Source
from mcap_encoding import (
    CDR,
    PROTOBUF,
    ROS_FROM_FOXGLOVE,
    as_ros,
    encode_cdr,
    encode_protobuf,
    encode_rvl,
    jsonable,
    schema_bytes,
)
from readers_data import HEIGHT, WIDTH, depth_values

SECOND = 1_000_000_000
RAW, COMPRESSED, CALIBRATION = "foxglove.RawImage", "foxglove.CompressedImage", "foxglove.CameraCalibration"
DEPTH, COLOUR, INFO = "/cam/depth/image", "/cam/color/image", "/cam/depth/camera_info"
OPTICAL = "cam_optical"
CAMERA = Camera(WIDTH, HEIGHT, 10, 11, 4, 3)


@dataclass
class Log:
    """Collects messages, then writes them all to a file."""

    messages: list[tuple[str, str, str, int, bytes]] = field(default_factory=list)

    def add(self, topic: str, schema: str, message: dict[str, Any], encoding: str, log_ns: int = 0) -> None:
        """Add a message of a schema, `foxglove.…` or a ROS name; a Foxglove name is translated for CDR."""
        if encoding == CDR:
            name = ROS_FROM_FOXGLOVE.get(schema, schema)
            data = encode_cdr(name, as_ros(schema, message))
        elif encoding == PROTOBUF:
            name, data = schema, encode_protobuf(schema, message)
        else:
            name, data = schema, json.dumps(jsonable(message)).encode()
        self.add_bytes(topic, name, encoding, data, log_ns or len(self.messages))

    def add_bytes(self, topic: str, schema: str, encoding: str, data: bytes, log_ns: int = 0) -> None:
        """Add a message as it is to be written."""
        self.messages.append((topic, schema, encoding, log_ns, data))

    def write(
        self, path: Path, compression: CompressionType = CompressionType.ZSTD, chunk_size: int = 1 << 20, **options: Any
    ) -> Path:
        """Write the file; the options are those of `mcap.writer.Writer`."""
        path.parent.mkdir(parents=True, exist_ok=True)
        with open(path, "wb") as stream:
            writer = Writer(stream, chunk_size=chunk_size, compression=compression, **options)
            writer.start(profile="", library="tests")
            channels: dict[tuple[str, str], int] = {}
            for topic, schema, encoding, log_ns, data in self.messages:
                if (topic, schema) not in channels:
                    schema_id = writer.register_schema(schema, *schema_bytes(schema, encoding))
                    channels[topic, schema] = writer.register_channel(topic, encoding, schema_id)
                writer.add_message(channels[topic, schema], log_ns, data, log_ns)
            writer.finish()
        return path


def stamp_of(seconds: float) -> dict[str, int]:
    nanoseconds = round(seconds * SECOND)
    return {"sec": nanoseconds // SECOND, "nanosec": nanoseconds % SECOND}


def ros_header(seconds: float, frame: str) -> dict[str, Any]:
    return {"stamp": stamp_of(seconds), "frame_id": frame}


def foxglove_header(seconds: float, frame: str) -> dict[str, Any]:
    stamp = stamp_of(seconds)
    return {"timestamp": {"sec": stamp["sec"], "nsec": stamp["nanosec"]}, "frame_id": frame}


def pose_message(pose: Floats) -> dict[str, Any]:
    quaternion = se3.to_quat_xyzw(pose)
    return {
        "position": dict(zip("xyz", pose[:3, 3].tolist(), strict=True)),
        "orientation": dict(zip("xyzw", quaternion.tolist(), strict=True)),
    }


def raw_image(image: np.ndarray, encoding: str, pad: int = 0) -> dict[str, Any]:
    """The fields of a raw image, with `pad` bytes at the end of each row."""
    rows = image.reshape(image.shape[0], -1).view(np.uint8)
    padded = np.pad(rows, ((0, 0), (0, pad)), constant_values=7)
    size = {"width": image.shape[1], "height": image.shape[0], "step": padded.shape[1]}
    return {**size, "encoding": encoding, "data": padded.tobytes()}


def png(image: np.ndarray) -> bytes:
    return bytes(cv2.imencode(".png", image)[1].tobytes())


def compressed_depth(millimetres: np.ndarray, coding: str = "png") -> dict[str, Any]:
    """The fields of a 16UC1 compressedDepth image."""
    return _compressed_depth(millimetres, f"16UC1; compressedDepth {coding}", coding, 0.0, 0.0)


def compressed_inverse_depth(metres: np.ndarray, coding: str = "png", a: float = 10100.0) -> dict[str, Any]:
    """The fields of a 32FC1 compressedDepth image, quantised as compressed_depth_image_transport does: 10 m at most."""
    b = 1.0 - a / 10.0
    with np.errstate(divide="ignore", invalid="ignore"):
        stored = np.where((metres > 0) & (metres < 10.0), a / metres + b, 0)
    return _compressed_depth(stored.astype(np.uint16), f"32FC1; compressedDepth {coding}", coding, a, b)


def _compressed_depth(stored: np.ndarray, declared: str, coding: str, a: float, b: float) -> dict[str, Any]:
    size = struct.pack("<II", stored.shape[1], stored.shape[0])
    body = png(stored) if coding == "png" else size + encode_rvl(stored)
    return {"format": declared, "data": struct.pack("<iff", 0, a, b) + body}


def calibration(width: int, height: int, fx: float, fy: float, cx: float, cy: float) -> dict[str, Any]:
    """The fields of a calibration without distortion, by their Foxglove names."""
    k = [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]
    p = [fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0]
    size = {"width": width, "height": height, "distortion_model": "plumb_bob"}
    return {**size, "D": [0.0] * 5, "K": k, "R": np.eye(3).reshape(-1).tolist(), "P": p}


def odometry(seconds: float, pose: Floats, frame: str = "odom", child: str = "base_link") -> dict[str, Any]:
    nested = {"pose": pose_message(pose), "covariance": [0.0] * 36}
    return {"header": ros_header(seconds, frame), "child_frame_id": child, "pose": nested}


def transforms(*links: tuple[float, str, str, Floats]) -> dict[str, Any]:
    """A TFMessage of links (stamp, parent, child, `parent_from_child`)."""
    out = []
    for seconds, parent, child, pose in links:
        motion = pose_message(pose)
        transform = {"translation": motion["position"], "rotation": motion["orientation"]}
        out.append({"header": ros_header(seconds, parent), "child_frame_id": child, "transform": transform})
    return {"transforms": out}


def point_cloud(
    columns: dict[str, np.ndarray], offsets: dict[str, int], step: int, height: int = 1, pad: int = 0
) -> dict[str, Any]:
    """The fields of a PointCloud2 of columns (N,), at these offsets of points of `step` bytes; junk in between."""
    codes = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}
    count = len(next(iter(columns.values())))
    contents = np.full((count, step), 0xA5, np.uint8)
    fields = []
    for name, column in columns.items():
        cells = np.ascontiguousarray(column).view(np.uint8).reshape(count, -1)
        contents[:, offsets[name] : offsets[name] + cells.shape[1]] = cells
        code = codes[column.dtype.str[1:]]
        fields.append({"name": name, "offset": offsets[name], "datatype": code, "count": 1})
    rows = np.pad(contents.reshape(height, -1), ((0, 0), (0, pad)))
    is_big = any(column.dtype.byteorder == ">" for column in columns.values())
    size = {"width": count // height, "height": height, "point_step": step, "row_step": rows.shape[1]}
    return {**size, "fields": fields, "is_bigendian": is_big, "data": rows.tobytes(), "is_dense": False}


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


def read_all(source: Source) -> int:
    """Read everything of every frame; how many frames were refused by `SourceError`, one line each."""
    refused = 0
    for frame in source.frames:
        try:
            for read in (frame.read_depth, frame.read_colour, frame.read_points, frame.encoded_depth):
                if read is not None:
                    read()
        except SourceError as error:
            assert "\n" not in str(error) and str(source.path) in str(error)
            refused += 1
    if source.trajectory is not None:
        assert se3.is_motion(source.trajectory.world_from_cam, 1e-6).all()
    return refused


def resident_peak() -> float:
    """The most memory, in bytes, that this process ever held."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024.0
