"""Messages in the encodings of MCAP recordings, written plainly so that the readers have something to be held against:
CDR by a ROS 2 definition, protobuf by a descriptor set, Foxglove JSON, and RVL.
"""

from __future__ import annotations

import base64
import struct
from collections.abc import Sequence
from typing import Any

import numpy as np

from hodge_adapters.mcap.ros_cdr import Field, parse_definition

CDR, PROTOBUF, JSON = "cdr", "protobuf", "json"
ENCODINGS = (CDR, PROTOBUF, JSON)

_SEPARATOR = "=" * 80
_TIME = "MSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
_HEADER = "MSG: std_msgs/Header\n# who and when\nbuiltin_interfaces/Time stamp\nstring frame_id\n"
_POINT = "MSG: geometry_msgs/Point\nfloat64 x\nfloat64 y\nfloat64 z\n"
_VECTOR = "MSG: geometry_msgs/Vector3\nfloat64 x\nfloat64 y\nfloat64 z\n"
_QUATERNION = "MSG: geometry_msgs/Quaternion\nfloat64 x 0\nfloat64 y 0\nfloat64 z 0\nfloat64 w 1\n"
_POSE = "MSG: geometry_msgs/Pose\nPoint position\nQuaternion orientation\n"
_WITH_COVARIANCE = "MSG: geometry_msgs/PoseWithCovariance\nPose pose\nfloat64[36] covariance\n"
_TRANSFORM = "MSG: geometry_msgs/Transform\nVector3 translation\nQuaternion rotation\n"
_STAMPED = "MSG: geometry_msgs/TransformStamped\nstd_msgs/Header header\nstring child_frame_id\nTransform transform\n"
_POINT_FIELD = (
    "MSG: sensor_msgs/PointField\nuint8 INT8=1\nuint8 FLOAT32 = 7 # a constant\n"
    "string name\nuint32 offset\nuint8 datatype\nuint32 count\n"
)


def _definition(body: str, *used: str) -> str:
    return f"\n{_SEPARATOR}\n".join((body, *used, _HEADER, _TIME))


ROS_SCHEMAS = {
    "sensor_msgs/msg/Image": _definition(
        "# an image\nstd_msgs/Header header\nuint32 height\nuint32 width\nstring encoding\nuint8 is_bigendian\n"
        "uint32 step\nuint8[] data\n"
    ),
    "sensor_msgs/msg/CompressedImage": _definition("std_msgs/Header header\nstring format\nuint8[] data\n"),
    "sensor_msgs/msg/CameraInfo": _definition(
        "std_msgs/Header header\nuint32 height\nuint32 width\nstring distortion_model\nfloat64[] d\nfloat64[9]  k\n"
        "float64[9]  r # 3x3\nfloat64[12] p\nuint32 binning_x\n"
    ),
    "sensor_msgs/msg/PointCloud2": _definition(
        "std_msgs/Header header\nuint32 height\nuint32 width\nPointField[] fields\nbool is_bigendian\n"
        "uint32 point_step\nuint32 row_step\nuint8[] data\nbool is_dense\n",
        _POINT_FIELD,
    ),
    "nav_msgs/msg/Odometry": _definition(
        "std_msgs/Header header\nstring child_frame_id\ngeometry_msgs/PoseWithCovariance pose\n",
        _WITH_COVARIANCE, _POSE, _POINT, _QUATERNION,
    ),
    "geometry_msgs/msg/PoseStamped": _definition("std_msgs/Header header\nPose pose\n", _POSE, _POINT, _QUATERNION),
    "tf2_msgs/msg/TFMessage": _definition(
        "geometry_msgs/TransformStamped[] transforms\n", _STAMPED, _TRANSFORM, _VECTOR, _QUATERNION
    ),
}  # fmt: skip

_DOUBLE, _INT32, _INT64, _FIXED32, _STRING, _MESSAGE, _BYTES, _UINT32, _ENUM = 1, 5, 3, 7, 9, 11, 12, 13, 14
_STAMP_FIELD = ("timestamp", 1, _MESSAGE, ".google.protobuf.Timestamp")
PROTO_TYPES: dict[str, list[tuple[str, int, int, str]]] = {
    "google.protobuf.Timestamp": [("seconds", 1, _INT64, ""), ("nanos", 2, _INT32, "")],
    "foxglove.Vector3": [(axis, number, _DOUBLE, "") for number, axis in enumerate("xyz", 1)],
    "foxglove.Quaternion": [(axis, number, _DOUBLE, "") for number, axis in enumerate("xyzw", 1)],
    "foxglove.Pose": [
        ("position", 1, _MESSAGE, ".foxglove.Vector3"), ("orientation", 2, _MESSAGE, ".foxglove.Quaternion")
    ],
    "foxglove.PackedElementField": [("name", 1, _STRING, ""), ("offset", 2, _FIXED32, ""), ("type", 3, _ENUM, "")],
    "foxglove.RawImage": [
        _STAMP_FIELD, ("frame_id", 7, _STRING, ""), ("width", 2, _FIXED32, ""), ("height", 3, _FIXED32, ""),
        ("encoding", 4, _STRING, ""), ("step", 5, _FIXED32, ""), ("data", 6, _BYTES, ""),
    ],
    "foxglove.CompressedImage": [
        _STAMP_FIELD, ("frame_id", 4, _STRING, ""), ("data", 2, _BYTES, ""), ("format", 3, _STRING, "")
    ],
    "foxglove.CameraCalibration": [
        _STAMP_FIELD, ("frame_id", 9, _STRING, ""), ("width", 2, _FIXED32, ""), ("height", 3, _FIXED32, ""),
        ("distortion_model", 4, _STRING, ""), ("D", 5, -_DOUBLE, ""), ("K", 6, -_DOUBLE, ""), ("R", 7, -_DOUBLE, ""),
        ("P", 8, -_DOUBLE, ""),
    ],
    "foxglove.PointCloud": [
        _STAMP_FIELD, ("frame_id", 2, _STRING, ""), ("pose", 3, _MESSAGE, ".foxglove.Pose"),
        ("point_stride", 4, _FIXED32, ""), ("fields", 5, -_MESSAGE, ".foxglove.PackedElementField"),
        ("data", 6, _BYTES, ""),
    ],
    "foxglove.PoseInFrame": [
        _STAMP_FIELD, ("frame_id", 2, _STRING, ""), ("pose", 3, _MESSAGE, ".foxglove.Pose")
    ],
    "foxglove.FrameTransform": [
        _STAMP_FIELD, ("parent_frame_id", 2, _STRING, ""), ("child_frame_id", 3, _STRING, ""),
        ("translation", 4, _MESSAGE, ".foxglove.Vector3"), ("rotation", 5, _MESSAGE, ".foxglove.Quaternion"),
    ],
}  # fmt: skip
"""Fields as (name, number, type, type name); a negative type is repeated."""

ROS_FROM_FOXGLOVE = {
    "foxglove.RawImage": "sensor_msgs/msg/Image",
    "foxglove.CompressedImage": "sensor_msgs/msg/CompressedImage",
    "foxglove.CameraCalibration": "sensor_msgs/msg/CameraInfo",
    "foxglove.PoseInFrame": "geometry_msgs/msg/PoseStamped",
}


def schema_bytes(schema: str, encoding: str) -> tuple[str, bytes]:
    if encoding == CDR:
        return "ros2msg", ROS_SCHEMAS.get(schema, "string data\n").encode()
    if encoding == PROTOBUF:
        return "protobuf", descriptor_set()
    return "jsonschema", b'{"type": "object"}'


def encode_cdr(name: str, message: dict[str, Any], big_endian: bool = False) -> bytes:
    """The CDR bytes of a message of `ROS_SCHEMAS`; absent fields are zero."""
    definitions = parse_definition(name, ROS_SCHEMAS[name])
    out = bytearray(b"\0\0\0\0" if big_endian else b"\0\1\0\0")
    _write_cdr(out, definitions, name.replace("/msg/", "/"), message, ">" if big_endian else "<")
    return bytes(out)


_CODES = {"bool": "?", "uint8": "B", "int32": "i", "uint32": "I", "float64": "d"}


def _write_cdr(out: bytearray, types: dict[str, list[Field]], name: str, message: dict[str, Any], order: str) -> None:
    for item in types[name]:
        code = _CODES.get(item.type)
        value = message.get(item.name, _zero(item, types))
        values = [value] if item.count is None else value
        if item.count == -1:
            _write_number(out, order, "I", len(value))
        if isinstance(value, bytes):
            out += value
        elif code:
            for number in values:
                _write_number(out, order, code, number)
        elif item.type == "string":
            for string in values:
                _write_number(out, order, "I", len(string.encode()) + 1)
                out += string.encode() + b"\0"
        else:
            for part in values:
                _write_cdr(out, types, item.type, part, order)


def _write_number(out: bytearray, order: str, code: str, number: Any) -> None:
    out += b"\0" * (-(len(out) - 4) % struct.calcsize(f"={code}"))
    out += struct.pack(order + code, number)


def _zero(item: Field, types: dict[str, list[Field]]) -> Any:
    zero: Any = "" if item.type == "string" else {} if item.type in types else 0
    return zero if item.count is None else [zero] * max(item.count, 0)


def as_ros(schema: str, message: dict[str, Any]) -> dict[str, Any]:
    """A Foxglove message with the names that ROS gives to its fields; ROS messages as they are."""
    if not schema.startswith("foxglove."):
        return message
    ros = {name.lower(): value for name, value in message.items()}
    stamp = ros.pop("timestamp", {"sec": 0, "nsec": 0})
    ros["header"] = {"stamp": {"sec": stamp["sec"], "nanosec": stamp["nsec"]}, "frame_id": ros.pop("frame_id", "")}
    return ros


def jsonable(value: Any) -> Any:
    """The message as Foxglove writes it in JSON."""
    if isinstance(value, bytes):
        return base64.b64encode(value).decode()
    if isinstance(value, dict):
        return {name: jsonable(item) for name, item in value.items()}
    return [jsonable(item) for item in value] if isinstance(value, list) else value


def encode_protobuf(schema: str, message: dict[str, Any]) -> bytes:
    """The wire bytes of a message of `PROTO_TYPES`; as proto3 does, zeros are left out."""
    if schema == "google.protobuf.Timestamp":
        message = {"seconds": message["sec"], "nanos": message["nsec"]}
    out = bytearray()
    for name, number, kind, type_name in PROTO_TYPES[schema]:
        value = message.get(name)
        if kind == -_DOUBLE and value:
            out += _tagged(number, struct.pack(f"<{len(value)}d", *value))
        elif value or (isinstance(value, dict) and kind == _MESSAGE):
            for one in value if kind < 0 else [value]:
                out += _proto_value(number, abs(kind), type_name.removeprefix("."), one)
    return bytes(out)


def descriptor_set() -> bytes:
    """A FileDescriptorSet with every type, one file for each package."""
    files = bytearray()
    for package in sorted({name.rpartition(".")[0] for name in PROTO_TYPES}):
        body = bytearray(_tagged(1, f"{package}.proto".encode()) + _tagged(2, package.encode()))
        for name, fields in PROTO_TYPES.items():
            if name.rpartition(".")[0] == package:
                message = _tagged(1, name.rpartition(".")[2].encode())
                body += _tagged(4, message + b"".join(_tagged(2, _field_descriptor(*item)) for item in fields))
        files += _tagged(1, bytes(body))
    return bytes(files)


def _field_descriptor(name: str, number: int, kind: int, type_name: str) -> bytes:
    label = 3 if kind < 0 else 1
    numbers = _varint(3 << 3) + _varint(number) + _varint(4 << 3) + _varint(label)
    numbers += _varint(5 << 3) + _varint(abs(kind))
    return _tagged(1, name.encode()) + numbers + (_tagged(6, type_name.encode()) if type_name else b"")


def _proto_value(number: int, kind: int, type_name: str, value: Any) -> bytes:
    if kind == _DOUBLE:
        return _varint(number << 3 | 1) + struct.pack("<d", value)
    if kind == _FIXED32:
        return _varint(number << 3 | 5) + struct.pack("<I", value)
    if kind == _MESSAGE:
        return _tagged(number, encode_protobuf(type_name, value))
    if kind in (_STRING, _BYTES):
        return _tagged(number, value.encode() if isinstance(value, str) else value)
    return _varint(number << 3) + _varint(value & 0xFFFFFFFFFFFFFFFF)


def _tagged(number: int, contents: bytes) -> bytes:
    return _varint(number << 3 | 2) + _varint(len(contents)) + contents


def _varint(value: int) -> bytes:
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*out, value])


def encode_rvl(image: np.ndarray) -> bytes:
    """The RVL code of a 16-bit image, number by number."""
    flat = image.reshape(-1).astype(np.int64)
    edges = np.flatnonzero(np.diff(flat != 0, prepend=False, append=False)).reshape(-1, 2)
    numbers: list[int] = []
    done, previous = 0, 0
    for start, stop in edges.tolist():
        deltas = np.diff(flat[start:stop], prepend=previous)
        numbers += [start - done, stop - start, *((deltas << 1) ^ (deltas >> 63)).tolist()]
        done, previous = stop, int(flat[stop - 1])
    if done < len(flat):
        numbers += [len(flat) - done, 0]
    return pack_nibbles(numbers)


def pack_nibbles(numbers: Sequence[int]) -> bytes:
    """Numbers in the nibbles of RVL, whatever they mean."""
    nibbles: list[int] = []
    for number in numbers:
        while number > 7:
            nibbles.append(number & 7 | 8)
            number >>= 3
        nibbles.append(number)
    nibbles += [0] * (-len(nibbles) % 8)
    pairs = np.array(nibbles, np.uint8).reshape(-1, 2)
    return (pairs[:, 0] << 4 | pairs[:, 1]).reshape(-1, 4)[:, ::-1].tobytes()
