"""Protobuf messages by the FileDescriptorSet that their MCAP schema holds.

The wire format is small, and only a few message types are read, so this takes no library. Byte fields are given as a
`slice` of the message, so that an image can be read again without its schema. Fields that are absent are absent from
the result: readers supply the default.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeAlias

from hodge_adapters.mcap.records import Malformed

_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5
_DOUBLE, _FLOAT, _INT64, _INT32, _BOOL, _STRING, _MESSAGE, _BYTE_STRING, _ENUM, _SINT32, _SINT64 = (
    1, 2, 3, 5, 8, 9, 11, 12, 14, 17, 18
)  # fmt: skip
_FIXED = {_DOUBLE: "<d", _FLOAT: "<f", 6: "<Q", 7: "<I", 15: "<i", 16: "<q"}
_SIGNED = frozenset((_INT64, _INT32, _ENUM))
_REPEATED = 3
_MAX_DEPTH = 16

Message: TypeAlias = dict[str, Any]
Wire: TypeAlias = tuple[int, int, int | slice]
"""Field number, wire type, and the value: a varint's number, or where the bytes lie."""


@dataclass(frozen=True)
class Field:
    """One field of a message type, as its descriptor says."""

    name: str
    type: int
    repeated: bool
    type_name: str


Types: TypeAlias = dict[str, dict[int, Field]]


def protobuf_decoder(name: str, descriptor_set: bytes) -> Callable[[bytes], Message]:
    """A function from the bytes of such a message to its fields; it raises `Malformed`.

    Raises `Malformed` where the descriptor set cannot be read or does not define all that the message uses.
    """
    types = parse_descriptors(descriptor_set)
    if name not in types:
        raise Malformed(f"its schema does not define {name}")
    return partial(_decode, types, name)


def parse_descriptors(descriptor_set: bytes) -> Types:
    """The fields of every message type in a FileDescriptorSet, by full name."""
    types: Types = {}
    whole = slice(0, len(descriptor_set))
    for file in _spans(descriptor_set, whole, 1):
        package = _texts(descriptor_set, file, 2)
        for message in _spans(descriptor_set, file, 4):
            _add_type(types, descriptor_set, message, package, 0)
    return types


def _add_type(types: Types, data: bytes, span: slice, parent: str, depth: int) -> None:
    if depth > _MAX_DEPTH:
        raise Malformed("its schema nests too deep")
    name = ".".join(filter(None, (parent, _texts(data, span, 1))))
    fields: dict[int, Field] = {}
    for field_span in _spans(data, span, 2):
        number, field = _parse_field(data, field_span)
        fields[number] = field
    types[name] = fields
    for nested in _spans(data, span, 3):
        _add_type(types, data, nested, name, depth + 1)


def _parse_field(data: bytes, span: slice) -> tuple[int, Field]:
    """The number of a field and its description, a FieldDescriptorProto."""
    values = {number: value for number, _, value in _wire(data, span)}
    numbers = {number: value for number, value in values.items() if isinstance(value, int)}
    name, type_name = (_text(data, values.get(number)) for number in (1, 6))
    field = Field(name, numbers.get(5, 0), numbers.get(4) == _REPEATED, type_name.removeprefix("."))
    return numbers.get(3, 0), field


def _decode(types: Types, name: str, data: bytes) -> Message:
    return _read(types, name, data, slice(0, len(data)), 0)


def _read(types: Types, name: str, data: bytes, span: slice, depth: int) -> Message:
    if depth > _MAX_DEPTH or name not in types:
        raise Malformed("its schema does not define all of it, or nests too deep")
    fields, message = types[name], Message()
    for number, wire, value in _wire(data, span):
        field = fields.get(number)
        if field is None:
            continue
        if field.repeated:
            message.setdefault(field.name, []).extend(_values(types, field, data, wire, value, depth))
        else:
            message[field.name] = _value(types, field, data, wire, value, depth)
    return message


def _values(types: Types, field: Field, data: bytes, wire: int, value: int | slice, depth: int) -> list[Any]:
    """One element, or all those of a packed field."""
    if wire != _BYTES or field.type in (_STRING, _MESSAGE, _BYTE_STRING):
        return [_value(types, field, data, wire, value, depth)]
    assert isinstance(value, slice)
    code = _FIXED.get(field.type)
    if code:
        if (value.stop - value.start) % struct.calcsize(code):
            raise Malformed("a packed field that breaks off")
        return [number for (number,) in struct.iter_unpack(code, data[value])]
    numbers, at = [], value.start
    while at < value.stop:
        number, at = _varint(data, at, value.stop)
        numbers.append(_number(field.type, number))
    return numbers


def _value(types: Types, field: Field, data: bytes, wire: int, value: int | slice, depth: int) -> Any:
    if isinstance(value, int):
        if wire != _VARINT or field.type in _FIXED or field.type in (_STRING, _MESSAGE, _BYTE_STRING):
            raise Malformed("a field of another type than its schema says")
        return _number(field.type, value)
    code = _FIXED.get(field.type)
    if code and wire != _BYTES and struct.calcsize(code) == value.stop - value.start:
        return struct.unpack_from(code, data, value.start)[0]
    if wire == _BYTES and field.type == _MESSAGE:
        return _read(types, field.type_name, data, value, depth + 1)
    if wire == _BYTES and field.type == _STRING:
        return data[value].decode("utf-8", "replace")
    if wire == _BYTES and field.type == _BYTE_STRING:
        return value
    raise Malformed("a field of another type than its schema says")


def _number(kind: int, value: int) -> int | bool:
    if kind == _BOOL:
        return bool(value)
    if kind in (_SINT32, _SINT64):
        return (value >> 1) ^ -(value & 1)
    return value - (1 << 64) if kind in _SIGNED and value >> 63 else value


def _wire(data: bytes, span: slice) -> Iterator[Wire]:
    at, end = span.start, span.stop
    while at < end:
        key, at = _varint(data, at, end)
        number, wire = key >> 3, key & 7
        if wire == _VARINT:
            value, at = _varint(data, at, end)
            yield number, wire, value
            continue
        if wire == _BYTES:
            length, at = _varint(data, at, end)
        elif wire in (_FIXED64, _FIXED32):
            length = 8 if wire == _FIXED64 else 4
        else:
            raise Malformed("not protobuf data")
        if length > end - at:
            raise Malformed("a message that is shorter than its fields say")
        yield number, wire, slice(at, at + length)
        at += length


def _varint(data: bytes, at: int, end: int) -> tuple[int, int]:
    if at < end and data[at] < 0x80:
        return data[at], at + 1
    value = 0
    for shift in range(0, 70, 7):
        if at >= end:
            break
        byte = data[at]
        at += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value & 0xFFFFFFFFFFFFFFFF, at
    raise Malformed("a message that is shorter than its fields say")


def _spans(data: bytes, span: slice, number: int) -> list[slice]:
    return [value for found, _, value in _wire(data, span) if found == number and isinstance(value, slice)]


def _texts(data: bytes, span: slice, number: int) -> str:
    return "".join(_text(data, value) for value in _spans(data, span, number)[-1:])


def _text(data: bytes, value: int | slice | None) -> str:
    return data[value].decode("utf-8", "replace") if isinstance(value, slice) else ""
