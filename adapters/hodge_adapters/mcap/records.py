"""The records of an MCAP file that is not trusted: every length is held against the file before anything is read.

Framing, limits and decompression are here; the `mcap` package parses the small records (schemas, channels, indexes).
Several faults are told apart by their `Malformed` text, which the caller counts and reports.
"""

from __future__ import annotations

import bz2
import struct
import zlib
from collections.abc import Callable, Iterator
from io import BytesIO
from pathlib import Path
from typing import IO, Any, NamedTuple

import lz4.frame  # type: ignore[import-untyped]
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode

from hodge_adapters.sqlite_file import DAMAGED, opened_database
from hodge_adapters.text_rows import reading
from hodge_pipeline.types.input_files import open_input

MAGIC = b"\x89MCAP0\r\n"
MAX_CHUNK_BYTES = 1 << 28
"""No chunk is expanded past 256 MiB: writers make chunks of 1 to 4 MiB, and one image of 64 megapixels fits."""
MAX_MESSAGE_BYTES = MAX_CHUNK_BYTES

_RECORD = struct.Struct("<BQ")
RECORD_HEAD_BYTES = _RECORD.size
_CHUNK_START = struct.Struct("<QQQII")
_FOOTER = struct.Struct("<BQQQI")
_MAX_NAME_BYTES = 64
_BLOCK_BYTES = 1 << 20

ReadAt = Callable[[int, int], bytes]


class Malformed(ValueError):
    """Bytes that are not what they say; the text is a reason, without the place."""


class Record(NamedTuple):
    """One record: its opcode, and where its body lies. `complete` is False for the one that a file breaks off in."""

    opcode: int
    start: int
    length: int
    complete: bool = True


class Chunk(NamedTuple):
    """Where the contents of a chunk lie in the file, and what the chunk says they expand to."""

    start: int
    length: int
    compression: str
    uncompressed_bytes: int
    crc: int


class Place(NamedTuple):
    """Where bytes lie: straight in the file, at an offset of a chunk's expanded contents, or of a message's row."""

    offset: int
    length: int
    chunk: Chunk | None = None
    row: int | None = None

    def part(self, start: int, stop: int) -> Place:
        """The place of a part of these bytes."""
        return self._replace(offset=self.offset + start, length=stop - start)


def read_at(file: IO[bytes]) -> ReadAt:
    """A function (offset, length) that reads from the file, fewer bytes at its end."""

    def read(offset: int, length: int) -> bytes:
        file.seek(offset)
        return file.read(length)

    return read


def read_place(path: Path, place: Place) -> bytes:
    """The bytes at a place; raises `Malformed` where they are not all there, `SourceError` without the file."""
    with reading(path), open_input(path) as file:
        if place.row is not None:
            contents = _read_row(path, place.row, place.offset, place.length)
        elif place.chunk is None:
            contents = read_at(file)(place.offset, place.length)
        else:
            expanded = expand(read_at(file), place.chunk, place.offset + place.length)
            contents = expanded[place.offset : place.offset + place.length]
    if len(contents) < place.length:
        raise Malformed("the file has changed since it was opened")
    return contents


def _read_row(path: Path, row: int, offset: int, length: int) -> bytes:
    """A part of a message of an SQLite bag."""
    try:
        with (
            opened_database(path, ("messages",), MAX_MESSAGE_BYTES) as database,
            database.blobopen("messages", "data", row, readonly=True) as blob,
        ):
            blob.seek(min(offset, len(blob)))
            return blob.read(length)
    except DAMAGED as error:
        raise Malformed("the file has changed since it was opened") from error


def records(read: ReadAt, start: int, end: int) -> Iterator[Record]:
    """The records between two offsets; the last one is cut short, and not complete, where it says it goes further."""
    at = start
    while at < end:
        head = read(at, min(_RECORD.size, end - at))
        if len(head) < _RECORD.size:
            yield Record(0, at + _RECORD.size, 0, complete=False)
            return
        opcode, length = _RECORD.unpack(head)
        body = at + _RECORD.size
        if length > end - body or opcode == 0:
            yield Record(opcode, body, end - body, complete=False)
            return
        yield Record(opcode, body, length)
        at = body + length


def parse(kind: Any, body: bytes) -> Any:
    """A small record of one of the `mcap.records` classes; raises `Malformed`."""
    try:
        return kind.read(ReadDataStream(BytesIO(body)))
    except (McapError, struct.error, ValueError) as error:
        raise Malformed(f"a {kind.__name__} record that cannot be read") from error


def parse_chunk(read: ReadAt, record: Record) -> Chunk:
    """What a chunk record says of itself. The data of an incomplete one end where the file does."""
    head = read(record.start, min(record.length, _CHUNK_START.size + _MAX_NAME_BYTES + 8))
    if len(head) < _CHUNK_START.size:
        raise Malformed("a chunk without a header")
    _, _, uncompressed_bytes, crc, name_bytes = _CHUNK_START.unpack_from(head)
    name_end = _CHUNK_START.size + name_bytes
    if name_bytes > _MAX_NAME_BYTES or len(head) < name_end + 8:
        raise Malformed("a chunk without a header")
    compression = head[_CHUNK_START.size : name_end].decode("ascii", "replace")
    (length,) = struct.unpack_from("<Q", head, name_end)
    available = record.length - name_end - 8
    if length > available and record.complete:
        raise Malformed("a chunk that says it is longer than its record")
    length = min(length, available)
    if compression not in ("", "zstd", "lz4"):
        raise Malformed(f"a chunk compressed by {compression!r}: only zstd, lz4 and none are known")
    if compression and max(uncompressed_bytes, length) > MAX_CHUNK_BYTES:
        raise Malformed(f"a chunk that says it expands to {uncompressed_bytes} bytes, the limit is {MAX_CHUNK_BYTES}")
    return Chunk(record.start + name_end + 8, length, compression, uncompressed_bytes, crc)


def expand(read: ReadAt, chunk: Chunk, limit: int) -> bytes:
    """The first `limit` bytes of a compressed chunk's contents, fewer where they end sooner; raises `Malformed`."""
    compressed = read(chunk.start, chunk.length)
    limit = min(limit, chunk.uncompressed_bytes)
    if not limit:
        return b""
    try:
        if chunk.compression == "zstd":
            # Not the one-shot call: it believes the size in the frame's own header, which nothing checks.
            return zstandard.ZstdDecompressor(max_window_size=MAX_CHUNK_BYTES).stream_reader(compressed).read(limit)
        if chunk.compression == "bz2":
            return bz2.BZ2Decompressor().decompress(compressed, max_length=limit)
        return bytes(lz4.frame.LZ4FrameDecompressor().decompress(compressed, max_length=limit))
    except (zstandard.ZstdError, RuntimeError, OSError, EOFError, MemoryError) as error:
        raise Malformed(f"a chunk that {chunk.compression} cannot expand") from error


def checksum(read: ReadAt, start: int, length: int) -> int:
    """CRC-32 of a part of the file, in blocks."""
    crc = 0
    for at in range(start, start + length, _BLOCK_BYTES):
        crc = zlib.crc32(read(at, min(_BLOCK_BYTES, start + length - at)), crc)
    return crc


def summary_span(read: ReadAt, size: int) -> tuple[int, int] | None:
    """(start, end) of the summary section, (end, end) where the file has none; None without a whole footer."""
    end = size - len(MAGIC) - _FOOTER.size
    tail = read(max(end, 0), _FOOTER.size + len(MAGIC))
    if end < len(MAGIC) or len(tail) != _FOOTER.size + len(MAGIC) or not tail.endswith(MAGIC):
        return None
    opcode, length, start, _, _ = _FOOTER.unpack_from(tail)
    if opcode != Opcode.FOOTER or length != _FOOTER.size - _RECORD.size:
        return None
    return (start, end) if len(MAGIC) <= start <= end else (end, end)
