"""ROS messages: the text of a `.msg` definition and of all it uses, and the bytes, CDR or ROS 1, that it describes.

Arrays of bytes and of structures of numbers, such as points, are not copied: they are given as a `slice` of the
message, with the bytes from one structure to the next as its step, so that an image or a cloud can be read again
without its schema.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeAlias

import numpy as np

from hodge_adapters.mcap.records import Malformed

_FORMATS = {
    "bool": "?", "byte": "B", "char": "B", "int8": "b", "uint8": "B", "int16": "h", "uint16": "H", "int32": "i",
    "uint32": "I", "int64": "q", "uint64": "Q", "float32": "f", "float64": "d",
}  # fmt: skip
_FIELD = re.compile(
    r"(?P<type>[A-Za-z][\w/]*)(?:<=\d+)?(?P<array>\[(?P<bound><=)?(?P<count>\d*)\])?\s+(?P<name>[A-Za-z]\w*)\s*(?P<constant>=)?"
)
_TIME = "int32 sec\nuint32 nanosec"
_ROS1_TIMES = {"time": "uint32 sec\nuint32 nanosec", "duration": _TIME}
_MAX_DEPTH = 16

Message: TypeAlias = dict[str, Any]


@dataclass(frozen=True)
class Field:
    """One field of a definition. `count`: None for a single value, -1 for a sequence, else a fixed array's length."""

    name: str
    type: str
    count: int | None


def parse_definition(name: str, text: str) -> dict[str, list[Field]]:
    """The fields of every type in a ros2msg or ros1msg text, by full name without `/msg/`; the first is `name`."""
    sections = re.split(r"^=+\s*$", text, flags=re.MULTILINE)
    times = {"builtin_interfaces/Time": _TIME, "builtin_interfaces/Duration": _TIME, **_ROS1_TIMES}
    types = {**times, _short(name): sections[0]}
    for section in sections[1:]:
        head, _, body = section.lstrip().partition("\n")
        if head.startswith("MSG:"):
            types[_short(head[4:].strip())] = body
    return {full: _fields(full, body) for full, body in types.items()}


def ros_decoder(name: str, text: str, *, ros1: bool = False) -> Callable[[bytes], Message]:
    """A function from the CDR bytes of such a message, or those of ROS 1, to its fields; it raises `Malformed`.

    Raises `Malformed` where the text does not define all that it uses.
    """
    definitions = parse_definition(name, text)
    for fields in definitions.values():
        for field in fields:
            if field.type not in _FORMATS and field.type not in ("string", "wstring") and field.type not in definitions:
                raise Malformed(f"its schema does not define {field.type}")
    return partial(_decode, definitions, _short(name), Ros1Cursor if ros1 else Cursor)


class Cursor:
    """Where in a message the reading is; every read is held against the message's end."""

    empty_bytes = 1
    """Of a message without fields: CDR knows no empty structure."""

    def __init__(self, data: bytes) -> None:
        if len(data) < 4 or data[0] or data[1] not in (0, 1, 6, 7):
            raise Malformed("not CDR data: plain CDR of version 1 or 2 is read")
        self.data, self.at, self.order = data, 4, "<" if data[1] & 1 else ">"
        self.max_alignment = 8 if data[1] < 2 else 4

    def align(self, size: int) -> None:
        """Go to the next multiple of a primitive's size, counted from after the four bytes in front."""
        self.at += -(self.at - 4) % min(size, self.max_alignment)

    def take(self, size: int) -> int:
        """Go over `size` bytes that must be there; gives where they start."""
        start, self.at = self.at, self.at + size
        if self.at > len(self.data):
            raise Malformed("a message that is shorter than its fields say")
        return start

    def value(self, code: str) -> Any:
        """The next primitive."""
        size = struct.calcsize(f"={code}")
        self.align(size)
        return struct.unpack_from(self.order + code, self.data, self.take(size))[0]

    def text(self, width: int) -> str:
        """The next string: UTF-8, or UTF-16 where `width` is 2."""
        length = int(self.value("I"))
        start = self.take(length * width)
        encoding = "utf-8" if width == 1 else "utf-16-le" if self.order == "<" else "utf-16-be"
        return self.data[start : start + length * width].decode(encoding, "replace").rstrip("\0")


class Ros1Cursor(Cursor):
    """The bytes of ROS 1: the same fields, one after the other without a head or gaps."""

    empty_bytes = 0

    def __init__(self, data: bytes) -> None:
        self.data, self.at, self.order, self.max_alignment = data, 0, "<", 1


def _decode(definitions: dict[str, list[Field]], name: str, cursor: type[Cursor], data: bytes) -> Message:
    return _read_message(cursor(data), definitions, name, 0)


def _read_message(cursor: Cursor, definitions: dict[str, list[Field]], name: str, depth: int) -> Message:
    if depth > _MAX_DEPTH:
        raise Malformed("its schema nests too deep")
    fields = definitions[name]
    if not fields:
        cursor.take(cursor.empty_bytes)
    return {field.name: _read_field(cursor, definitions, field, depth) for field in fields}


def _read_field(cursor: Cursor, definitions: dict[str, list[Field]], field: Field, depth: int) -> Any:
    code = _FORMATS.get(field.type)
    if field.count is None:
        return cursor.value(code) if code else _read_one(cursor, definitions, field.type, depth)
    count = cursor.value("I") if field.count < 0 else field.count
    if code:
        return _read_array(cursor, code, count)
    if count > len(cursor.data) - cursor.at:
        raise Malformed("a message that is shorter than its fields say")
    if plain := _structures(cursor, definitions.get(field.type, []), count):
        return plain
    return [_read_one(cursor, definitions, field.type, depth) for _ in range(count)]


def _structures(cursor: Cursor, fields: list[Field], count: int) -> slice | None:
    """Go over structures of numbers alone; None where they hold anything else, or begin with a number that is not their
    largest, so that they have no fixed step.
    """
    codes = [_FORMATS.get(field.type, "") if field.count is None else "" for field in fields]
    sizes = [struct.calcsize(f"={code}") if code else 0 for code in codes]
    if not count or not sizes or not all(sizes) or max(sizes) > sizes[0]:
        return None
    size = 0
    for each in sizes:
        size += -size % min(each, cursor.max_alignment) + each
    step = size + -size % min(sizes[0], cursor.max_alignment)
    cursor.align(sizes[0])
    start = cursor.take(step * (count - 1) + size)
    return slice(start, cursor.at, step)


def _read_one(cursor: Cursor, definitions: dict[str, list[Field]], name: str, depth: int) -> Any:
    if name in ("string", "wstring"):
        return cursor.text(1 if name == "string" else 2)
    return _read_message(cursor, definitions, name, depth + 1)


def _read_array(cursor: Cursor, code: str, count: int) -> Any:
    size = struct.calcsize(f"={code}")
    if count:
        cursor.align(size)
    start = cursor.take(size * count)
    if code in "Bb":
        return slice(start, cursor.at)
    return np.frombuffer(cursor.data, np.dtype(cursor.order + code), count, start)


def _short(name: str) -> str:
    return name.replace("/msg/", "/")


def _fields(owner: str, body: str) -> list[Field]:
    fields = []
    for line in body.splitlines():
        match = _FIELD.match(line.split("#", 1)[0].strip())
        if match and not match["constant"]:
            count = (
                None if match["array"] is None else -1 if match["bound"] or not match["count"] else int(match["count"])
            )
            fields.append(Field(match["name"], _resolved(match["type"], owner), count))
    return fields


def _resolved(name: str, owner: str) -> str:
    if name in _FORMATS or name in ("string", "wstring") or name in _ROS1_TIMES:
        return name
    if "/" not in name:
        return "std_msgs/Header" if name == "Header" else f"{owner.split('/')[0]}/{name}"
    return _short(name)
