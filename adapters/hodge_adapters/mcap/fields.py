"""Messages of any encoding as dictionaries, and fields taken out of them by the type that they must have.

ROS 2 (CDR), Foxglove protobuf and Foxglove JSON differ in names (`K` or `k`, `nanosec`, `nsec` or `nanos`) and in
whether a zero is written at all, so an absent number is 0, and a zero that makes no sense is refused where it is used.
"""

from __future__ import annotations

import base64
import binascii
import json
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from mcap.records import Channel, Schema

from hodge_adapters.mcap.protobuf import protobuf_decoder
from hodge_adapters.mcap.records import Malformed, Place, read_place
from hodge_adapters.mcap.ros_cdr import ros_decoder
from hodge_pipeline import se3
from hodge_pipeline.errors import SourceError
from hodge_pipeline.types import Floats

Message: TypeAlias = dict[str, Any]
Decoder: TypeAlias = Callable[[bytes], Message]


@dataclass(frozen=True)
class Payload:
    """Where the bytes of an image or a cloud lie, to be read again without decoding their message.

    `in_json` means that the place is a JSON message with the bytes in base64 in its field `data`. `record` names
    topic and stamp for errors.
    """

    path: Path
    place: Place
    record: str
    in_json: bool = False

    def read(self) -> bytes:
        """The bytes; raises `SourceError`."""
        try:
            contents = read_place(self.path, self.place)
            return _unpacked(decode_json(contents).get("data")) if self.in_json else contents
        except Malformed as error:
            raise self.error(str(error)) from error

    def error(self, reason: str) -> SourceError:
        """The error that names file, topic, stamp, reason and remedy."""
        return SourceError(f"{self.path}: {self.record}: {reason}: record it again, or leave it out")


def decoder_for(channel: Channel, schema: Schema | None) -> Decoder:
    """The decoder of a channel's messages; raises `Malformed` that says why there is none."""
    encodings = channel.message_encoding, schema.encoding if schema else ""
    if encodings[0] == "json":
        return decode_json
    if schema and encodings in (("cdr", "ros2msg"), ("ros1", "ros1msg")):
        return ros_decoder(schema.name, schema.data.decode("utf-8", "replace"), ros1=encodings[0] == "ros1")
    if schema and encodings == ("protobuf", "protobuf"):
        return protobuf_decoder(schema.name, schema.data)
    raise Malformed(
        f"{encodings[0]} messages with {encodings[1] or 'no'} schema: record ROS messages, protobuf or JSON"
    )


def decode_json(data: bytes) -> Message:
    """The object that a JSON message holds; raises `Malformed`."""
    try:
        message = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise Malformed("not JSON") from error
    if not isinstance(message, dict):
        raise Malformed("JSON that is no object")
    return message


def payload_of(message: Message, path: Path, place: Place, record: str) -> tuple[Payload, int]:
    """Where the field `data` of a message lies, and how many bytes it holds."""
    data = message.get("data", slice(0, 0))
    if isinstance(data, slice):
        return Payload(path, place.part(data.start, data.stop), record), data.stop - data.start
    if isinstance(data, str):
        return Payload(path, place, record, in_json=True), len(data.rstrip("=")) * 3 // 4
    raise Malformed("no bytes in its field data")


def payload_start(message: Message, contents: bytes, length: int) -> bytes:
    """The first bytes of the field `data`."""
    data = message.get("data", b"")
    if isinstance(data, slice):
        return contents[data.start : min(data.stop, data.start + length)]
    return _unpacked(data[: -(-length // 3) * 4]) if isinstance(data, str) else b""


def number(message: Message, *names: str) -> float:
    """The number under the first of these names that is there, else 0; raises `Malformed` where it is no number."""
    name = next((name for name in names if name in message), None)
    if name is None:
        return 0
    value = message[name]
    if not isinstance(value, (int, float, np.number)):
        raise Malformed(f"no number in its field {name}")
    return value  # type: ignore[return-value]


def whole(message: Message, *names: str) -> int:
    """The whole number under the first of these names that is there, else 0; raises `Malformed` for any other value."""
    value = number(message, *names)
    if not math.isfinite(value) or value != int(value):
        raise Malformed(f"no whole number in its field {names[0]}")
    return int(value)


def text(message: Message, name: str) -> str:
    """The text under a name, empty where it is absent; raises `Malformed`."""
    value = message.get(name, "")
    if not isinstance(value, str):
        raise Malformed(f"no text in its field {name}")
    return value


def part(message: Message, *names: str) -> Message:
    """The message under the first of these names that is there, else an empty one; raises `Malformed`."""
    value: Any = next((message[name] for name in names if name in message), {})
    if not isinstance(value, dict):
        raise Malformed(f"no message in its field {names[0]}")
    return value


def parts(message: Message, name: str) -> list[Message]:
    """The messages under a name; raises `Malformed`."""
    value = message.get(name, [])
    if not isinstance(value, list) or not all(isinstance(item, dict) for item in value):
        raise Malformed(f"no messages in its field {name}")
    return value


def numbers(message: Message, *names: str) -> Floats:
    """The numbers (N,) under the first of these names that is there, else none; raises `Malformed`."""
    value = next((message[name] for name in names if name in message), ())
    try:
        return np.asarray(value, float).reshape(-1)
    except (TypeError, ValueError, OverflowError) as error:
        raise Malformed(f"no numbers in its field {names[0]}") from error


def stamp_s(message: Message) -> float:
    """The time of a header, or of a Foxglove `timestamp`, in seconds; 0 where it was never set."""
    time = part(part(message, "header"), "stamp") if "header" in message else part(message, "timestamp")
    stamp = number(time, "sec", "seconds") + 1e-9 * number(time, "nanosec", "nsec", "nanos")
    if not math.isfinite(stamp):
        raise Malformed("a stamp that is not finite")
    return float(stamp)


def frame_id(message: Message) -> str:
    """The coordinate frame of a header or of a Foxglove message, without the slash that old recordings put first."""
    return text(part(message, "header") if "header" in message else message, "frame_id").lstrip("/")


def pose_values(translation: Message, quaternion: Message) -> tuple[float, ...]:
    """(x, y, z, qx, qy, qz, qw); raises `Malformed` where they are no rigid motion."""
    values = [number(translation, axis) for axis in "xyz"] + [number(quaternion, axis) for axis in "xyzw"]
    if (
        not all(abs(value) < se3.MAX_NUMBER for value in values)
        or not 0.25 < sum(value * value for value in values[3:]) < 4
    ):
        raise Malformed("a pose that is no rigid motion")
    return tuple(values)


def _unpacked(data: object) -> bytes:
    if not isinstance(data, str):
        raise Malformed("no base64 in its field data")
    try:
        return base64.b64decode(data)
    except (binascii.Error, ValueError) as error:
        raise Malformed("no base64 in its field data") from error
