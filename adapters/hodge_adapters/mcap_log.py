"""The messages of one MCAP file in the order of the file: indexed or not, whole, cut off or damaged in the middle."""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, NamedTuple

from mcap.opcode import Opcode
from mcap.records import Channel, ChunkIndex, Schema

from hodge_adapters.mcap_complaints import Complaints
from hodge_adapters.mcap_records import (
    MAGIC,
    MAX_MESSAGE_BYTES,
    RECORD_HEAD_BYTES,
    Chunk,
    Malformed,
    Place,
    ReadAt,
    Record,
    checksum,
    expand,
    parse,
    parse_chunk,
    read_at,
    records,
    summary_span,
)
from hodge_pipeline.errors import SourceError
from hodge_pipeline.types.input_files import open_input

_MESSAGE = struct.Struct("<HIQQ")
_MAX_SMALL_RECORD_BYTES = 1 << 24
MAX_EXPANSION, ALWAYS_EXPANDED_BYTES = 200, 1 << 31
"""Images and scans shrink to a half or a tenth: the chunks of a file together expand to no more, and 2 GiB."""


class Logged(NamedTuple):
    """One message as logged: `place` is where `data` lies, to read it again."""

    channel: Channel
    schema: Schema | None
    log_time_ns: int
    data: bytes
    place: Place


@dataclass
class Tally:
    """How many messages of a topic were logged, wanted or not, and when the first and the last."""

    count: int = 0
    first_ns: int = 0
    last_ns: int = 0

    def add(self, log_time_ns: int) -> None:
        """One message more."""
        self.first_ns = min(self.first_ns, log_time_ns) if self.count else log_time_ns
        self.last_ns = max(self.last_ns, log_time_ns)
        self.count += 1

    def __str__(self) -> str:
        span_s = (self.last_ns - self.first_ns) * 1e-9
        return f"{self.count} messages" + (f", {(self.count - 1) / span_s:.3g} a second" if span_s > 0 else "")


Wanted = Callable[[Channel, Schema | None], bool]


@dataclass
class LogFile:
    """One file while it is read: what its records have said so far. Iterate `messages` once."""

    path: Path
    wanted: Wanted
    complaints: Complaints
    channels: dict[int, Channel] = field(default_factory=dict)
    schemas: dict[int, Schema] = field(default_factory=dict)
    tallies: dict[str, Tally] = field(default_factory=dict)
    _is_wanted: dict[int, bool] = field(default_factory=dict)
    _chunk_offsets: list[int] = field(default_factory=list)
    _has_footer: bool = False
    _expansion_left: int = 0
    _count: int = 0
    _first_ns: int = 0
    _last_ns: int = 0

    def messages(self) -> Iterator[Logged]:
        """The wanted messages. Raises `SourceError` for a file that is no MCAP; all else is complained of."""
        try:
            with open_input(self.path) as file:
                yield from self._messages(file)
        except OSError as error:
            remedy = "restore the file or its permissions"
            raise SourceError(f"{self.path}: cannot be read ({error.strerror}): {remedy}") from error

    def _messages(self, file: IO[bytes]) -> Iterator[Logged]:
        read, size = read_at(file), os.fstat(file.fileno()).st_size
        if read(0, len(MAGIC)) != MAGIC:
            raise SourceError(f"{self.path}: does not start as an MCAP file: record or copy it again")
        self._expansion_left = ALWAYS_EXPANDED_BYTES + MAX_EXPANSION * size
        self._read_summary(read, size)
        at: int | None = len(MAGIC)
        while at is not None and at < size:
            for record in records(read, at, size):
                at = record.start + record.length
                if record.opcode in (Opcode.DATA_END, Opcode.FOOTER) and record.complete:
                    return
                yield from self._record(read, record)
                if not record.complete:
                    at = self._after_damage(record, size)
        if at is not None and not self._has_footer:
            self.complaints.say(f"{self.path.name}: not finished by its recorder: all {size} bytes were read")

    def _read_summary(self, read: ReadAt, size: int) -> None:
        """Channels and chunks from the end of the file: needed only where their records in front are damaged."""
        span = summary_span(read, size)
        self._has_footer = span is not None
        for record in records(read, *span) if span else ():
            if record.opcode == Opcode.CHUNK_INDEX and record.length <= _MAX_SMALL_RECORD_BYTES:
                try:
                    index = parse(ChunkIndex, read(record.start, record.length))
                except Malformed:
                    continue
                self._chunk_offsets.append(index.chunk_start_offset)
            elif record.complete:
                self._definition(read, record)
        self._chunk_offsets.sort()

    def _after_damage(self, record: Record, size: int) -> int | None:
        """Where to go on after a record that does not end: the next chunk that the summary knows of, else the end.

        None in a file that was cut off, which has no summary.
        """
        damage = record.start - RECORD_HEAD_BYTES
        if not self._has_footer:
            until = f"whole records up to byte {damage} of {size} were read, with what is left of the next"
            self.complaints.say(f"{self.path.name}: cut off: {until}: {self._told()}")
            return None
        following = next((offset for offset in self._chunk_offsets if offset >= record.start), size)
        self.complaints.say(f"{self.path.name}: damaged at byte {damage}: went on at byte {following}")
        return following

    def _told(self) -> str:
        """How much was read, for what is said of a file that ends too early."""
        if not self._count:
            return "no message of use"
        return f"{self._count} messages of use, logged within {(self._last_ns - self._first_ns) * 1e-9:.3f} s"

    def _record(self, read: ReadAt, record: Record) -> Iterator[Logged]:
        if record.opcode == Opcode.CHUNK:
            try:
                chunk = parse_chunk(read, record)
                yield from self._chunk(read, chunk, record.complete)
            except Malformed as error:
                self.complaints.count(self.path.name, str(error))
        elif record.opcode == Opcode.MESSAGE:
            yield from self._message(read, record, None)
        elif record.complete:
            self._definition(read, record)

    def _chunk(self, read: ReadAt, chunk: Chunk, complete: bool) -> Iterator[Logged]:
        if chunk.compression:
            if chunk.uncompressed_bytes > self._expansion_left:
                raise Malformed("a chunk past what a file of this size may expand to")
            self._expansion_left -= chunk.uncompressed_bytes
            contents = expand(read, chunk, chunk.uncompressed_bytes)
            crc = zlib.crc32(contents) if chunk.crc else 0
            inner: ReadAt = lambda offset, length: contents[offset : offset + length]  # noqa: E731
            start, end, outer = 0, len(contents), chunk
        else:
            crc = checksum(read, chunk.start, chunk.length) if chunk.crc else 0
            inner, start, end, outer = read, chunk.start, chunk.start + chunk.length, None
        if complete and chunk.crc != crc:
            raise Malformed("a chunk whose checksum does not hold")
        for record in records(inner, start, end):
            if record.opcode == Opcode.MESSAGE:
                yield from self._message(inner, record, outer)
            elif record.complete:
                self._definition(inner, record)
            if complete and not record.complete:
                raise Malformed("a chunk that breaks off")

    def _message(self, read: ReadAt, record: Record, chunk: Chunk | None) -> Iterator[Logged]:
        if record.length < _MESSAGE.size or not record.complete:
            self.complaints.count(self.path.name, "a message that breaks off")
            return
        channel_id, _, log_time_ns, _ = _MESSAGE.unpack(read(record.start, _MESSAGE.size))
        if channel_id not in self.channels:
            self.complaints.count(self.path.name, "a message of a channel that the file does not define")
            return
        self.tallies.setdefault(self.channels[channel_id].topic, Tally()).add(log_time_ns)
        if self._wants(channel_id):
            channel = self.channels[channel_id]
            place = Place(record.start + _MESSAGE.size, record.length - _MESSAGE.size, chunk)
            if place.length > MAX_MESSAGE_BYTES:
                self.complaints.count(channel.topic, f"a message of more than {MAX_MESSAGE_BYTES} bytes")
                return
            data = read(place.offset, place.length)
            self._first_ns = min(self._first_ns, log_time_ns) if self._count else log_time_ns
            self._last_ns = max(self._last_ns, log_time_ns)
            self._count += 1
            yield Logged(channel, self.schemas.get(channel.schema_id), log_time_ns, data, place)

    def _wants(self, channel_id: int) -> bool:
        if channel_id not in self._is_wanted:
            channel = self.channels[channel_id]
            self._is_wanted[channel_id] = self.wanted(channel, self.schemas.get(channel.schema_id))
        return self._is_wanted[channel_id]

    def _definition(self, read: ReadAt, record: Record) -> None:
        if record.opcode not in (Opcode.SCHEMA, Opcode.CHANNEL) or record.length > _MAX_SMALL_RECORD_BYTES:
            return
        kind = Schema if record.opcode == Opcode.SCHEMA else Channel
        try:
            parsed = parse(kind, read(record.start, record.length))
        except Malformed as error:
            self.complaints.count(self.path.name, str(error))
            return
        # The summary came first: a definition that differs from it is the damaged one of the two.
        known: dict[int, Schema | Channel] = self.schemas if kind is Schema else self.channels  # type: ignore[assignment]
        known.setdefault(parsed.id, parsed)
