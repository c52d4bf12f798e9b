"""Size and completeness of a PNG or JPEG file, by its header and markers, before it is decoded."""

from __future__ import annotations

import re
import struct
import zlib
from dataclasses import dataclass
from pathlib import Path

from hodge_pipeline.errors import SourceError

MAX_PIXELS = 1 << 26
"""No depth or colour camera is larger than 64 megapixels; a header that says so would only exhaust memory."""

MAX_SIDE = 1 << 16
"""Pixels: no image is as wide or as high."""

_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_JPEG_START, _JPEG_END = b"\xff\xd8", 0xD9
_JPEG_SIZE_MARKERS = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_JPEG_BETWEEN_SCANS = frozenset((0xC4, 0xCC, 0xDA, 0xDB, 0xDC, 0xDD, 0xFE, *range(0xE0, 0xF0)))
_JPEG_MARKER = re.compile(rb"\xff[^\x00\xd0-\xd7]", re.DOTALL)
"""Within coded data 0xFF is followed by 0 or a restart marker."""
_JPEG_BARE_MARKERS = frozenset((0x01, *range(0xD0, 0xD9)))


@dataclass(frozen=True)
class ImageHeader:
    """Type and size in pixels of an image file; `body` is the offset at which its header ends."""

    media_type: str
    width: int
    height: int
    body: int


def parse_header(contents: bytes, path: Path) -> ImageHeader:
    """Type and size of a PNG or JPEG; raises `SourceError` that names the file."""
    if contents.startswith(_PNG_SIGNATURE) and len(contents) >= 24:
        width, height = struct.unpack_from(">II", contents, 16)
        header = ImageHeader("image/png", width, height, len(_PNG_SIGNATURE))
    elif contents.startswith(_JPEG_START):
        header = _parse_jpeg(contents, path)
    elif not contents:
        raise SourceError(f"{path}: the file is empty: copy it again from its source")
    else:
        raise SourceError(f"{path}: neither PNG nor JPEG: convert it to PNG (depth with all 16 bits), or leave it out")
    if not 0 < header.width * header.height <= MAX_PIXELS:
        raise SourceError(f"{path}: its header says {header.width}x{header.height} pixels: it is damaged")
    return header


def is_complete(contents: bytes, header: ImageHeader) -> bool:
    """Whether the file goes on to its end marker, and a PNG's checksums hold.

    A JPEG has none: what overwrote a part of it is seen by markers that cannot stand there, a few changed bits are not.
    """
    return _png_is_complete(contents) if header.media_type == "image/png" else _jpeg_is_complete(contents, header)


def _parse_jpeg(contents: bytes, path: Path) -> ImageHeader:
    at, size = 2, None
    while at + 4 <= len(contents) and contents[at] == 0xFF:
        marker = contents[at + 1]
        if marker == 0xFF or marker in _JPEG_BARE_MARKERS:
            at += 1 if marker == 0xFF else 2
            continue
        (length,) = struct.unpack_from(">H", contents, at + 2)
        if marker in _JPEG_SIZE_MARKERS and at + 9 <= len(contents):
            size = struct.unpack_from(">HH", contents, at + 5)
        at += 2 + length
        if marker == 0xDA or (size and at > len(contents)):
            break
    if size is None:
        raise SourceError(f"{path}: the image is truncated or damaged: copy it again from its source")
    return ImageHeader("image/jpeg", size[1], size[0], at)


def _jpeg_is_complete(contents: bytes, header: ImageHeader) -> bool:
    # An embedded thumbnail has an end marker of its own, so only one after the header counts.
    at = header.body
    while found := _JPEG_MARKER.search(contents, at):
        marker, at = contents[found.end() - 1], found.end()
        if marker == _JPEG_END:
            return True
        if marker == 0xFF:
            at -= 1
        elif marker in _JPEG_BETWEEN_SCANS and at + 2 <= len(contents):
            at += struct.unpack_from(">H", contents, at)[0]
        else:
            return False
    return False


def _png_is_complete(contents: bytes) -> bool:
    """Whether every chunk up to IEND is there with its checksum (17 µs for a depth image, 3 ms to decode it)."""
    view, at = memoryview(contents), len(_PNG_SIGNATURE)
    while at + 12 <= len(contents):
        (length,) = struct.unpack_from(">I", contents, at)
        end = at + 8 + length
        if end + 4 > len(contents) or zlib.crc32(view[at + 4 : end]) != struct.unpack_from(">I", contents, end)[0]:
            return False
        if contents[at + 4 : at + 8] == b"IEND":
            return True
        at = end + 4
    return False
