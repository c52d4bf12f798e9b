"""ROS 1 bags (format 2.0): the messages of a file in its order, with an index or without, whole or cut off."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import partial
from typing import IO

from mcap.records import Channel, Schema

from hodge_adapters.mcap.message_file import Logged, MessageFile
from hodge_adapters.mcap.records import Chunk, Malformed, Place, ReadAt

MAGIC = b"#ROSBAG V2.0\n"
MESSAGE, CHUNK, CONNECTION = 2, 5, 7
MAX_HEADER_BYTES = 1 << 20
"""Of a record: an operation, a number, a time and names."""
MAX_DEFINITION_BYTES = 1 << 24
_LENGTH, _NUMBER, _TIME = struct.Struct("<I"), struct.Struct("<I"), struct.Struct("<II")
Header = dict[str, bytes]


class BreaksOff(Malformed):
    """The file ends within a record."""


@dataclass
class BagFile(MessageFile):
    """One ROS 1 bag while it is read. Its definitions are text that describes bytes; nothing of them is executed."""

    _channels: dict[int, tuple[Channel, Schema]] = field(default_factory=dict)

    def _messages(self, file: IO[bytes]) -> Iterator[Logged]:
        read, size = self.begun(file, MAGIC, "a ROS 1 bag")
        yield from self._records(read, len(MAGIC), size)

    def _records(
        self, read: ReadAt, at: int, end: int, chunk: Chunk | None = None, *, inside: bool = False
    ) -> Iterator[Logged]:
        while at < end:
            try:
                header, start, length, complete = _record(read, at, end)
                operation = header.get("op", b"")
                if not operation:  # zeroed bytes are empty records without end, eight bytes each
                    raise BreaksOff
                if operation == bytes([MESSAGE]) and complete:
                    yield from self._message(read, header, Place(start, length, chunk))
                elif operation == bytes([CONNECTION]) and complete:
                    self._connection(header, read(start, min(length, MAX_DEFINITION_BYTES)))
                elif operation == bytes([CHUNK]) and not inside:
                    yield from self._chunk(read, header, start, length)
                if not complete:
                    raise BreaksOff
                at = start + length
            except BreaksOff:
                self.complaints.loses(
                    self.path, f"{self.path.name}: cut off at byte {at} of {end}: {self.read_so_far()}"
                )
                return
            except Malformed as error:
                self.complaints.damaged.add(self.path)
                self.complaints.count(self.path.name, str(error))
                at = start + length

    def _chunk(self, read: ReadAt, header: Header, start: int, length: int) -> Iterator[Logged]:
        compression = header.get("compression", b"").decode("ascii", "replace")
        if compression == "none":
            yield from self._records(read, start, start + length, inside=True)
            return
        if compression not in ("bz2", "lz4"):
            raise Malformed(f"a chunk compressed by {compression!r}: only bz2, lz4 and none are known")
        (size,) = _unpacked(_NUMBER, header, "size")
        chunk = Chunk(start, length, compression, size, 0)
        contents = self.expanded(read, chunk)
        part: ReadAt = lambda offset, count: contents[offset : offset + count]  # noqa: E731
        yield from self._records(part, 0, len(contents), chunk, inside=True)

    def _connection(self, header: Header, data: bytes) -> None:
        (number,) = _unpacked(_NUMBER, header, "conn")
        described = _fields(data)
        topic = header.get("topic", b"").decode("utf-8", "replace")
        name = described.get("type", b"").decode("utf-8", "replace")
        schema = Schema(number, described.get("message_definition", b""), "ros1msg", name)
        self._channels.setdefault(number, (Channel(number, topic, "ros1", {}, number), schema))

    def _message(self, read: ReadAt, header: Header, place: Place) -> Iterator[Logged]:
        (number,), (sec, nanosec) = _unpacked(_NUMBER, header, "conn"), _unpacked(_TIME, header, "time")
        if number not in self._channels:
            raise Malformed("a message of a connection that the file does not define")
        contents = partial(read, place.offset, place.length)
        yield from self.offered(*self._channels[number], sec * 1_000_000_000 + nanosec, place, contents)


def _record(read: ReadAt, at: int, end: int) -> tuple[Header, int, int, bool]:
    """The header of the record at an offset, where its data lies and how much is there, and whether that is all.

    Raises `BreaksOff` where even the header does not end.
    """
    start = at + _LENGTH.size
    size = _length(read, at)
    if size > min(MAX_HEADER_BYTES, end - start):
        raise BreaksOff
    length = _length(read, start + size)
    body = start + size + _LENGTH.size
    return _fields(read(start, size)), body, min(length, end - body), length <= end - body


def _length(read: ReadAt, at: int) -> int:
    found = read(at, _LENGTH.size)
    if len(found) < _LENGTH.size:
        raise BreaksOff
    return int(_LENGTH.unpack(found)[0])


def _fields(header: bytes) -> Header:
    """The `name=value` fields of a header, as far as they go."""
    fields, at = {}, 0
    while at + _LENGTH.size <= len(header):
        (size,) = _LENGTH.unpack_from(header, at)
        name, equals, value = header[at + _LENGTH.size : at + _LENGTH.size + size].partition(b"=")
        if equals:
            fields[name.decode("ascii", "replace")] = value
        at += _LENGTH.size + size
    return fields


def _unpacked(form: struct.Struct, header: Header, name: str) -> tuple[int, ...]:
    try:
        return form.unpack(header[name])
    except (KeyError, struct.error) as error:
        raise Malformed(f"a record without a sound field '{name}'") from error
