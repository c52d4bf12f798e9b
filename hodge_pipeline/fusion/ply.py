"""PLY files of fused scenes: binary, little-endian, written atomically."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from hodge_pipeline.errors import SourceError
from hodge_pipeline.store.artifacts import write_atomically
from hodge_pipeline.types import Model
from hodge_pipeline.types.input_files import open_input

POINTS, NORMALS, COLOURS = ("x", "y", "z"), ("nx", "ny", "nz"), ("red", "green", "blue")
FACE = np.dtype([("count", "u1"), ("vertices", "<i4", (3,))])
FACE_PROPERTY = "list uchar int vertex_indices"
TYPES = {"float": "<f4", "uchar": "u1"}
MAX_HEADER_LINES = 1000


def write_ply(path: Path, model: Model) -> None:
    """Write the model to a file that is either whole or not there; its name and notes are comments of the header."""
    vertices = _vertices(model)
    lines = ["ply", "format binary_little_endian 1.0", f"comment name {_one_line(model.name)}"]
    lines += [f"comment note {_one_line(note)}" for note in model.notes]
    lines += [f"element vertex {len(vertices)}"]
    lines += [f"property {'float' if kind.kind == 'f' else 'uchar'} {name}" for name, kind in _properties(vertices)]
    if model.triangles is not None:
        lines += [f"element face {len(model.triangles)}", f"property {FACE_PROPERTY}"]
    faces = np.zeros(0 if model.triangles is None else len(model.triangles), FACE)
    if model.triangles is not None:
        faces["count"], faces["vertices"] = 3, model.triangles

    def write(stream: IO[bytes]) -> None:
        stream.write("\n".join([*lines, "end_header", ""]).encode())
        stream.write(vertices.data)
        stream.write(faces.data)

    write_atomically(path, write)


def read_ply(path: Path) -> Model:
    """The model that `write_ply` wrote. `SourceError` for a file of another layout, or one cut short."""
    with open_input(path) as file:
        header = _read_header(file, path)
        vertices = _read(file, header.vertex_type, header.counts.get("vertex", 0), path)
        faces = _read(file, FACE, header.counts["face"], path) if "face" in header.counts else None
    return Model(
        name=header.name or path.stem,
        points_in_world=_columns(vertices, POINTS, np.float32, path),
        normals_in_world=_columns(vertices, NORMALS, np.float32, path) if "nx" in header.properties else None,
        colours=_columns(vertices, COLOURS, np.uint8, path) if "red" in header.properties else None,
        triangles=None if faces is None else np.ascontiguousarray(faces["vertices"], np.int32),
        notes=tuple(header.notes),
    )


@dataclass
class _Header:
    name: str = ""
    notes: list[str] = field(default_factory=list)
    counts: dict[str, int] = field(default_factory=dict)
    properties: dict[str, str] = field(default_factory=dict)

    @property
    def vertex_type(self) -> np.dtype[Any]:
        return np.dtype(list(self.properties.items()))


def _one_line(text: str) -> str:
    return " ".join(text.split())


def _properties(vertices: NDArray[np.void]) -> list[tuple[str, np.dtype[Any]]]:
    return [(name, vertices.dtype[name]) for name in vertices.dtype.names or ()]


def _vertices(model: Model) -> NDArray[np.void]:
    columns: list[tuple[tuple[str, ...], str, NDArray[Any] | None]] = [
        (POINTS, "<f4", model.points_in_world),
        (NORMALS, "<f4", model.normals_in_world),
        (COLOURS, "u1", model.colours),
    ]
    present = [(names, kind, values) for names, kind, values in columns if values is not None]
    kinds = [(name, kind) for names, kind, _ in present for name in names]
    vertices = np.zeros(len(model.points_in_world), np.dtype(kinds))
    for names, _, values in present:
        for axis, name in enumerate(names):
            vertices[name] = values[:, axis]
    return vertices


def _read_header(file: IO[bytes], path: Path) -> _Header:
    header = _Header()
    for row in range(MAX_HEADER_LINES):
        line = file.readline().decode("utf-8", "replace").strip()
        if row == 0 and line != "ply":
            raise SourceError(f"{path}: not a PLY file: it begins with {line[:20]!r}")
        if line == "end_header":
            return header
        _take(header, line, path)
    raise SourceError(f"{path}: the header has no end_header line")


def _take(header: _Header, line: str, path: Path) -> None:
    match line.split(" ", 2):
        case ["format", kind, *_] if kind != "binary_little_endian":
            raise SourceError(f"{path}: format {kind}: only binary_little_endian is read here")
        case ["comment", "name", name]:
            header.name = name
        case ["comment", "note", note]:
            header.notes.append(note)
        case ["element", name, count] if name in ("vertex", "face") and count.isdigit():
            header.counts[name] = int(count)
        case ["property", kind, name] if kind in TYPES and "face" not in header.counts:
            header.properties[name] = TYPES[kind]
        case ["property", *rest] if " ".join(rest) != FACE_PROPERTY:
            raise SourceError(f"{path}: property {' '.join(rest)!r}: expected float or uchar, or {FACE_PROPERTY!r}")
        case ["element", *rest]:
            raise SourceError(f"{path}: element {' '.join(rest)!r}: expected a number of vertex or face")


def _read(file: IO[bytes], kind: np.dtype[Any], count: int, path: Path) -> NDArray[np.void]:
    contents = file.read(kind.itemsize * count)
    if len(contents) < kind.itemsize * count:
        raise SourceError(
            f"{path}: cut short: {count} rows of {kind.itemsize} bytes expected, {len(contents)} bytes there"
        )
    return np.frombuffer(contents, kind, count)


def _columns(vertices: NDArray[np.void], names: tuple[str, ...], kind: Any, path: Path) -> Any:
    missing = [name for name in names if name not in (vertices.dtype.names or ())]
    if missing:
        raise SourceError(f"{path}: vertices have no {', '.join(missing)}")
    return np.stack([vertices[name] for name in names], axis=1).astype(kind)
