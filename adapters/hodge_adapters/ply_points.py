"""Points of PLY files (ascii, binary of either byte order), read no further than the file is long, and written."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from hodge_adapters.point_columns import ROWS_IN_PART, number_rows, points_of_parts
from hodge_adapters.text_rows import write_bytes_atomically
from hodge_pipeline.errors import SourceError
from hodge_pipeline.types import PointCloud
from hodge_pipeline.types.input_files import open_input

MAX_HEADER_BYTES = 1 << 16
TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}
FORMATS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
COLOURS = {
    "diffuse_red": "red",
    "diffuse_green": "green",
    "diffuse_blue": "blue",
    "r": "red",
    "g": "green",
    "b": "blue",
}


@dataclass(frozen=True)
class PlyHeader:
    """Where the vertices lie: `count` records of `properties` (name, type) after `start` bytes and `lines` lines."""

    order: str
    count: int
    properties: tuple[tuple[str, str], ...]
    start: int
    lines: int

    @property
    def dtype(self) -> np.dtype[Any]:
        """One vertex in a binary file."""
        return np.dtype([(name, self.order + code) for name, code in self.properties])


def read_ply(path: Path) -> PointCloud:
    """The vertices, with normals and colours where they have them; points that are not finite are left out.

    Raises `SourceError` for a damaged header, for one that promises more than there is, for no x, y, z.
    """
    try:
        with open_input(path) as file:
            header = _read_header(path, file)
            parts = _binary_parts if header.order else _ascii_parts
            return points_of_parts(path, parts(path, file, header))
    except OSError as error:
        raise SourceError(f"{path}: cannot be read ({error.strerror}): restore the file or its permissions") from error


def write_ply(path: Path, cloud: PointCloud) -> None:
    """A binary PLY of float32 points, with normals and colours where the cloud has them; written atomically."""
    columns: list[tuple[str, str, str, Any]] = [
        (name, "f4", "float", cloud.points_in_cam[:, at]) for at, name in enumerate("xyz")
    ]
    if cloud.normals_in_cam is not None:
        columns += [(f"n{name}", "f4", "float", cloud.normals_in_cam[:, at]) for at, name in enumerate("xyz")]
    if cloud.colours is not None:
        names = ("red", "green", "blue")
        columns += [(name, "u1", "uchar", cloud.colours[:, at]) for at, name in enumerate(names)]
    table = np.empty(len(cloud), [(name, f"<{code}") for name, code, _, _ in columns])
    for name, _, _, values in columns:
        table[name] = values
    properties = "".join(f"property {kind} {name}\n" for name, _, kind, _ in columns)
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(cloud)}\n{properties}end_header\n"
    write_bytes_atomically(path, header.encode() + table.tobytes())


def _read_header(path: Path, file: BinaryIO) -> PlyHeader:
    contents = file.read(MAX_HEADER_BYTES)
    end = contents.find(b"end_header")
    after = contents.find(b"\n", end)
    if not contents.startswith(b"ply") or end < 0 or after < 0:
        raise SourceError(f"{path}: no PLY header: is it another format, or cut off?")
    order, elements = None, list[tuple[str, int, list[tuple[str, str]]]]()
    for line in contents[:end].decode("ascii", "replace").splitlines()[1:]:
        match line.split():
            case ["format", name, *_] if name in FORMATS:
                order = FORMATS[name]
            case ["element", name, count] if count.isascii() and count.isdecimal() and len(count) < 16:
                elements.append((name, int(count), []))
            case ["property", "list", *_] if elements:
                elements[-1][2].append(("list", "list"))
            case ["property", kind, name] if kind in TYPES and elements:
                elements[-1][2].append((name, TYPES[kind]))
            case [] | ["comment", *_] | ["obj_info", *_]:
                pass
            case _:
                raise SourceError(f"{path}: its header has the line `{line[:60]}`, which is no PLY: make it again")
    if order is None:
        raise SourceError(f"{path}: its header names no format of PLY: make it again")
    return _vertices(path, order, elements, after + 1)


def _vertices(path: Path, order: str, elements: list[tuple[str, int, list[tuple[str, str]]]], start: int) -> PlyHeader:
    lines = 0
    for name, count, properties in elements:
        has_list = any(kind == "list" for _, kind in properties)
        if name == "vertex":
            if has_list or len({name for name, _ in properties}) < len(properties):
                raise SourceError(f"{path}: its vertices hold lists or a property twice: write plain points")
            return PlyHeader(order, count, tuple(properties), start, lines)
        if has_list and order:
            raise SourceError(f"{path}: {name} with lists lies before the vertices: write the vertices first")
        start += count * sum(np.dtype(kind).itemsize for _, kind in properties) if order else 0
        lines += count
    raise SourceError(f"{path}: no vertices in it: give a PLY with points")


def _binary_parts(path: Path, file: BinaryIO, header: PlyHeader) -> Iterator[dict[str, Any]]:
    room = path.stat().st_size - header.start
    if header.count * header.dtype.itemsize > room:
        raise SourceError(f"{path}: says {header.count} points, has {max(room, 0)} bytes for them: copy it again")
    file.seek(header.start)
    for start in range(0, max(header.count, 1), ROWS_IN_PART):
        table = np.fromfile(file, header.dtype, min(ROWS_IN_PART, header.count - start))
        yield {COLOURS.get(name, name): table[name] for name, _ in header.properties}


def _ascii_parts(path: Path, file: BinaryIO, header: PlyHeader) -> Iterator[dict[str, Any]]:
    file.seek(header.start)
    for _ in islice(file, header.lines):
        pass
    names = [COLOURS.get(name, name) for name, _ in header.properties]
    for table in number_rows(path, file, header.count, len(names)):
        yield dict(zip(names, table.T, strict=True))
