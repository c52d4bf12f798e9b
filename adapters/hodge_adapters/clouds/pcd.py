"""Points of PCD files: ascii, binary, and binary_compressed (LZF), which never expands past what the header says."""

from __future__ import annotations

import io
import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hodge_adapters.clouds.columns import (
    COLOURS,
    PACKED,
    as_declared,
    columns_called,
    number_rows,
    parts_of,
    refuse_more,
    unpacked,
)
from hodge_adapters.text_rows import reading
from hodge_pipeline.errors import SourceError
from hodge_pipeline.types.input_files import read_input

MAX_HEADER_BYTES = 1 << 14
MAX_EXPANSION = 264
"""LZF writes at most so many bytes for one that it reads."""
MAX_EXPANDED_BYTES = 1 << 30
"""Compressed points are expanded whole: 1 GiB are 30 million points with normals and colours."""
_CODES = {"F": "f", "I": "i", "U": "u"}


@dataclass(frozen=True)
class PcdHeader:
    """`count` points of `fields` (name, type, count), stored as `kind` after `start` bytes."""

    fields: tuple[tuple[str, str, int], ...]
    count: int
    kind: str
    start: int

    @property
    def dtype(self) -> np.dtype[Any]:
        """One point in a binary file."""
        return np.dtype([(name, code, (count,)) if count > 1 else (name, code) for name, code, count in self.fields])


def pcd_parts(path: Path) -> Iterator[dict[str, Any]]:
    """The points as columns, in parts. Raises `SourceError` for a damaged header, or one that promises too much."""
    with reading(path):
        contents = read_input(path)
    header = _read_header(path, contents)
    read = {"ascii": _read_ascii, "binary": _read_binary, "binary_compressed": _read_compressed}[header.kind]
    return map(unpacked, read(path, contents, header))


def expand_lzf(compressed: bytes, size: int) -> bytearray | None:
    """What LZF compressed, if it is exactly `size` bytes; None where it is damaged."""
    out, at, end = bytearray(), 0, len(compressed)
    try:
        while at < end and len(out) <= size:
            control = compressed[at]
            at += 1
            if control < 32:
                out += compressed[at : at + control + 1]
                at += control + 1
                continue
            length = control >> 5
            if length == 7:
                length += compressed[at]
                at += 1
            back = ((control & 31) << 8 | compressed[at]) + 1
            at += 1
            start = len(out) - back
            if start < 0:
                return None
            piece = out[start : start + length + 2]
            # A match may run into what it writes: then it repeats.
            out += (piece * (length // len(piece) + 2))[: length + 2]
    except IndexError:
        return None
    return out if len(out) == size and at == end else None


def _read_header(path: Path, contents: bytes) -> PcdHeader:
    entries: dict[str, list[str]] = {}
    at = 0
    while "DATA" not in entries:
        end = contents.find(b"\n", at, MAX_HEADER_BYTES)
        if end < 0:
            raise SourceError(f"{path}: no PCD header with DATA in it: is it another format, or cut off?")
        words = contents[at:end].decode("ascii", "replace").split()
        at = end + 1
        if words and not words[0].startswith("#"):
            entries[words[0]] = words[1:]
    names, sizes, kinds = (entries.get(key, []) for key in ("FIELDS", "SIZE", "TYPE"))
    names = columns_called(names)
    counts = entries.get("COUNT") or ["1"] * len(names)
    points = entries.get("POINTS") or [_product(entries)]
    data = " ".join(entries["DATA"])
    sound = names and len(names) == len(sizes) == len(kinds) == len(counts) and len(points) == 1
    sound = sound and all(_is_count(word, 9999) and int(word) for word in counts) and _is_count(points[0], 1 << 40)
    good = sound and all(_is_type(kind, size) for kind, size in zip(kinds, sizes, strict=True))
    if not good or data not in ("ascii", "binary", "binary_compressed"):
        raise SourceError(
            f"{path}: its header does not fit together (FIELDS SIZE TYPE COUNT POINTS DATA): make it again"
        )
    fields = [
        (f"_{row}" if name == "_" or name in names[:row] else name, f"<{_CODES[kind]}{size}", int(count))
        for row, (name, kind, size, count) in enumerate(zip(names, kinds, sizes, counts, strict=True))
    ]
    return PcdHeader(tuple(fields), int(points[0]), data, at)


def _product(entries: Mapping[str, list[str]]) -> str:
    """WIDTH times HEIGHT, `?` where they are no counts."""
    sides = [*entries.get("WIDTH", []), *entries.get("HEIGHT", [])]
    sound = len(sides) == 2 and all(_is_count(side, 1 << 40) for side in sides)
    return str(int(sides[0]) * int(sides[1])) if sound else "?"


def _is_count(word: str, limit: int) -> bool:
    return word.isascii() and word.isdecimal() and len(word) < 16 and int(word) <= limit


def _is_type(kind: str, size: str) -> bool:
    return (kind in "IU" and size in ("1", "2", "4", "8")) or (kind == "F" and size in ("4", "8"))


def _read_ascii(path: Path, contents: bytes, header: PcdHeader) -> Iterator[dict[str, Any]]:
    width = sum(count for _, _, count in header.fields)
    file = io.BytesIO(contents)
    file.seek(header.start)
    lines = filter(bytes.strip, file)
    for table in number_rows(path, lines, header.count, width):
        columns, at = {}, 0
        for name, code, count in header.fields:
            column = table[:, at]
            # Packed colours are the bits of the number that is written.
            columns[name] = as_declared(column, code) if name in (*PACKED, *COLOURS) else column
            at += count
        yield columns
    refuse_more(path, lines, header.count)


def _read_binary(path: Path, contents: bytes, header: PcdHeader) -> Iterator[dict[str, Any]]:
    if header.count * header.dtype.itemsize > len(contents) - header.start:
        raise SourceError(f"{path}: says {header.count} points, which its bytes cannot hold: copy it again")
    table = np.frombuffer(contents, header.dtype, header.count, header.start)
    yield from parts_of({name: table[name] for name, _, count in header.fields if count == 1})


def _read_compressed(path: Path, contents: bytes, header: PcdHeader) -> Iterator[dict[str, Any]]:
    size = header.count * header.dtype.itemsize
    if size > MAX_EXPANDED_BYTES:
        raise SourceError(
            f"{path}: expands to {size} bytes, the limit is {MAX_EXPANDED_BYTES}: write it as DATA binary"
        )
    if len(contents) < header.start + 8:
        raise SourceError(f"{path}: cut off after its header: copy it again")
    packed, unpacked = struct.unpack_from("<II", contents, header.start)
    expanded = None
    if unpacked == size <= packed * MAX_EXPANSION and packed <= len(contents) - header.start - 8:
        expanded = expand_lzf(contents[header.start + 8 : header.start + 8 + packed], size)
    if expanded is None:
        raise SourceError(f"{path}: its compressed points are damaged or cut off: copy it again")
    columns, at = {}, 0
    for name, code, count in header.fields:
        column = np.frombuffer(expanded, code, header.count * count, at)
        if count == 1:
            columns[name] = column
        at += column.nbytes
    yield from parts_of(columns)
