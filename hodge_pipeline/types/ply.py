"""PLY files: headers, binary vertices in parts, and models. Sizes that a header states are checked against the file.

It serves fused models, and points of other programs (see `hodge_adapters.clouds.ply`).
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from hodge_pipeline.errors import SourceError, not_read
from hodge_pipeline.types import Model
from hodge_pipeline.types.input_files import open_input

MAX_HEADER_BYTES = 1 << 16
ROWS_IN_PART = 1 << 20
"""Vertices that are read at once."""
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
POINTS, NORMALS, COLOURS = ("x", "y", "z"), ("nx", "ny", "nz"), ("red", "green", "blue")
FACE = np.dtype([("count", "u1"), ("vertices", "<i4", (3,))])
FACE_PROPERTY = "list uchar int vertex_indices"


@dataclass(frozen=True)
class PlyHeader:
    """The header of a PLY file with vertices.

    - `order`: the byte order of numpy, "" of text; `count` vertices of `properties` (name, numpy type).
    - `start`, `lines`: the bytes, in a text file the lines, before the first vertex.
    - `triangles`: how many follow in the form that we write, None without them; `is_last`: no element follows.
    """

    order: str
    count: int
    properties: tuple[tuple[str, str], ...]
    start: int
    lines: int
    triangles: int | None
    comments: tuple[str, ...]
    is_last: bool

    @property
    def dtype(self) -> np.dtype[Any]:
        """One vertex in a binary file."""
        return np.dtype([(name, self.order + code) for name, code in self.properties])


@dataclass
class _Element:
    """An element of a header; `declared` holds its list properties as written."""

    name: str
    count: int
    properties: list[tuple[str, str]]
    declared: list[str]


def read_header(path: Path, file: BinaryIO) -> PlyHeader:
    """The header at the beginning of a file. Raises `SourceError` for a damaged one, or vertices that are no points."""
    contents = file.read(MAX_HEADER_BYTES)
    end = contents.find(b"end_header")
    after = contents.find(b"\n", end)
    if not contents.startswith(b"ply") or end < 0 or after < 0:
        raise SourceError(f"{path}: no PLY header: is it another format, or cut off?")
    order: str | None = None
    elements: list[_Element] = []
    comments: list[str] = []
    for line in contents[:end].decode("utf-8", "replace").splitlines()[1:]:
        match line.split():
            case ["format", name, *_] if name in FORMATS:
                order = FORMATS[name]
            case ["element", name, count] if count.isascii() and count.isdecimal() and len(count) < 16:
                elements.append(_Element(name, int(count), [], []))
            case ["property", "list", *words] if elements:
                elements[-1].properties.append(("list", "list"))
                elements[-1].declared.append(" ".join(["list", *words]))
            case ["property", kind, name] if kind in TYPES and elements:
                elements[-1].properties.append((name, TYPES[kind]))
            case ["comment", *words]:
                comments.append(" ".join(words))
            case [] | ["obj_info", *_]:
                pass
            case _:
                raise SourceError(f"{path}: its header has the line `{line[:60]}`, which is no PLY: make it again")
    if order is None:
        raise SourceError(f"{path}: its header names no format of PLY: make it again")
    return _vertices(path, order, elements, after + 1, tuple(comments))


def _vertices(path: Path, order: str, elements: list[_Element], start: int, comments: tuple[str, ...]) -> PlyHeader:
    """The header by its elements, with what lies before the vertices skipped."""
    lines = 0
    for row, element in enumerate(elements):
        if element.name == "vertex":
            names = {name for name, _ in element.properties}
            if element.declared or not names or len(names) < len(element.properties):
                raise SourceError(f"{path}: its vertices hold lists, nothing or a property twice: write plain points")
            after = elements[row + 1 :]
            ours = len(after) == 1 and after[0].name == "face" and after[0].declared == [FACE_PROPERTY]
            triangles = after[0].count if ours and len(after[0].properties) == 1 else None
            properties = tuple(element.properties)
            return PlyHeader(order, element.count, properties, start, lines, triangles, comments, not after)
        if element.declared and order:
            raise SourceError(f"{path}: {element.name} with lists lies before the vertices: write the vertices first")
        start += element.count * sum(np.dtype(kind).itemsize for _, kind in element.properties) if order else 0
        lines += element.count
    raise SourceError(f"{path}: no vertices in it: give a PLY with points")


def vertex_parts(path: Path, file: BinaryIO, header: PlyHeader) -> Iterator[NDArray[np.void]]:
    """The vertices of a binary file in parts, at least one. Raises `SourceError` where the file is too short."""
    _check_length(path, file, header.start, header.count * header.dtype.itemsize, header.count, "points")
    file.seek(header.start)
    for start in range(0, max(header.count, 1), ROWS_IN_PART):
        yield np.fromfile(file, header.dtype, min(ROWS_IN_PART, header.count - start))


def read_model(path: Path) -> Model:
    """The model in a file that `model_parts` made. Raises `SourceError` for any other."""
    try:
        with open_input(path) as file:
            header = read_header(path, file)
            if not header.order:
                raise SourceError(f"{path}: format ascii: models are binary")
            vertices = np.concatenate(list(vertex_parts(path, file, header)))
            faces = None
            if header.triangles is not None:
                _check_length(path, file, file.tell(), header.triangles * FACE.itemsize, header.triangles, "triangles")
                faces = np.fromfile(file, FACE, header.triangles)
    except OSError as error:
        raise not_read(path, error) from error
    told = [comment.partition(" ") for comment in header.comments]
    names = {name for name, _ in header.properties}
    return Model(
        name=next((words for kind, _, words in told if kind == "name"), path.stem),
        points_in_world=_columns(path, vertices, POINTS, np.float32),
        normals_in_world=_columns(path, vertices, NORMALS, np.float32) if "nx" in names else None,
        colours=_columns(path, vertices, COLOURS, np.uint8) if "red" in names else None,
        triangles=None if faces is None else np.ascontiguousarray(faces["vertices"], np.int32),
        notes=tuple(words for kind, _, words in told if kind == "note"),
    )


def model_parts(model: Model) -> tuple[Any, ...]:
    """The bytes of a binary, little-endian file in parts; the header's comments hold the model's name and notes."""
    vertices = _records(model)
    lines = ["ply", "format binary_little_endian 1.0"]
    lines += [f"comment name {_one_line(model.name)}"] if model.name else []
    lines += [f"comment note {_one_line(note)}" for note in model.notes]
    lines += [f"element vertex {len(vertices)}"]
    kinds = [(name, vertices.dtype[name].kind) for name in vertices.dtype.names or ()]
    lines += [f"property {'float' if kind == 'f' else 'uchar'} {name}" for name, kind in kinds]
    faces = np.zeros(0 if model.triangles is None else len(model.triangles), FACE)
    if model.triangles is not None:
        lines += [f"element face {len(faces)}", f"property {FACE_PROPERTY}"]
        faces["count"], faces["vertices"] = 3, model.triangles
    return "\n".join([*lines, "end_header", ""]).encode(), vertices.data, faces.data


def _records(model: Model) -> NDArray[np.void]:
    columns: list[tuple[tuple[str, ...], str, NDArray[Any] | None]] = [
        (POINTS, "<f4", model.points_in_world),
        (NORMALS, "<f4", model.normals_in_world),
        (COLOURS, "u1", model.colours),
    ]
    present = [(names, kind, values) for names, kind, values in columns if values is not None]
    records = np.zeros(len(model.points_in_world), [(name, kind) for names, kind, _ in present for name in names])
    for names, _, values in present:
        for axis, name in enumerate(names):
            records[name] = values[:, axis]
    return records


def _one_line(text: str) -> str:
    return " ".join(text.split())


def _check_length(path: Path, file: BinaryIO, start: int, size: int, count: int, what: str) -> None:
    room = os.fstat(file.fileno()).st_size - start
    if size > room:
        raise SourceError(f"{path}: says {count} {what}, has {max(room, 0)} bytes for them: copy it again")


def _columns(path: Path, records: NDArray[np.void], names: tuple[str, ...], kind: Any) -> Any:
    missing = [name for name in names if name not in (records.dtype.names or ())]
    if missing:
        raise SourceError(f"{path}: vertices have no {', '.join(missing)}")
    return np.stack([records[name] for name in names], axis=1).astype(kind)
