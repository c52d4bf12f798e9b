"""The messages of one MCAP file in the order of the file: indexed or not, whole, cut off or damaged in the middle."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import partial
from typing import IO

from mcap.opcode import Opcode
from mcap.records import Channel, ChunkIndex, Schema

from hodge_adapters.mcap.message_file import Logged, MessageFile
from hodge_adapters.mcap.records import (
    MAGIC,
    RECORD_HEAD_BYTES,
    Chunk,
    Malformed,
    Place,
    ReadAt,
    Record,
    checksum,
    parse,
    parse_chunk,
    records,
    summary_span,
)

_MESSAGE = struct.Struct("<HIQQ")
_MAX_SMALL_RECORD_BYTES = 1 << 24


@dataclass
class LogFile(MessageFile):
    """One MCAP file while it is read: what its records have said so far."""

    channels: dict[int, Channel] = field(default_factory=dict)
    schemas: dict[int, Schema] = field(default_factory=dict)
    _chunk_offsets: list[int] = field(default_factory=list)
    _has_footer: bool = False

    def _messages(self, file: IO[bytes]) -> Iterator[Logged]:
        read, size = self.begun(file, MAGIC, "an MCAP file")
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
            self.complaints.loses(self.path, f"{self.path.name}: cut off: {until}: {self.read_so_far()}")
            return None
        following = next((offset for offset in self._chunk_offsets if offset >= record.start), size)
        self.complaints.loses(self.path, f"{self.path.name}: damaged at byte {damage}: went on at byte {following}")
        return following

    def _record(self, read: ReadAt, record: Record) -> Iterator[Logged]:
        if record.opcode == Opcode.CHUNK:
            try:
                chunk = parse_chunk(read, record)
                yield from self._chunk(read, chunk, record.complete)
            except Malformed as error:
                self.complaints.damaged.add(self.path)
                self.complaints.count(self.path.name, str(error))
        elif record.opcode == Opcode.MESSAGE:
            yield from self._message(read, record, None)
        elif record.complete:
            self._definition(read, record)

    def _chunk(self, read: ReadAt, chunk: Chunk, complete: bool) -> Iterator[Logged]:
        if chunk.compression:
            contents = self.expanded(read, chunk)
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
        channel = self.channels[channel_id]
        place = Place(record.start + _MESSAGE.size, record.length - _MESSAGE.size, chunk)
        contents = partial(read, place.offset, place.length)
        yield from self.offered(channel, self.schemas.get(channel.schema_id), log_time_ns, place, contents)

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
