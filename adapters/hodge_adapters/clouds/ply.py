"""Points of PLY files (ascii, binary of either byte order), and written; the codec is `hodge_pipeline.types.ply`."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Any, BinaryIO

from hodge_adapters.clouds.columns import COLOURS, as_declared, columns_called, number_rows, refuse_more
from hodge_adapters.text_rows import reading, write_bytes_atomically
from hodge_pipeline.types import Model, PointCloud
from hodge_pipeline.types.input_files import open_input
from hodge_pipeline.types.ply import PlyHeader, model_parts, read_header, vertex_parts


def ply_parts(path: Path) -> Iterator[dict[str, Any]]:
    """The vertices as columns, in parts. Raises `SourceError` for a damaged header, or one that promises too much."""
    with reading(path), open_input(path) as file:
        header = read_header(path, file)
        parts = _binary_parts if header.order else _ascii_parts
        yield from parts(path, file, header)


def write_ply(path: Path, cloud: PointCloud) -> None:
    """A binary PLY of float32 points, with normals and colours where the cloud has them; written atomically."""
    model = Model("", cloud.points_in_cam, cloud.normals_in_cam, cloud.colours)
    write_bytes_atomically(path, b"".join(model_parts(model)))


def _binary_parts(path: Path, file: BinaryIO, header: PlyHeader) -> Iterator[dict[str, Any]]:
    names = [name for name, _ in header.properties]
    for records in vertex_parts(path, file, header):
        yield {called: records[name] for called, name in zip(columns_called(names), names, strict=True)}


def _ascii_parts(path: Path, file: BinaryIO, header: PlyHeader) -> Iterator[dict[str, Any]]:
    file.seek(header.start)
    for _ in islice(file, header.lines):
        pass
    lines = filter(bytes.strip, file)
    names = columns_called([name for name, _ in header.properties])
    for table in number_rows(path, lines, header.count, len(names)):
        columns = {}
        for name, (_, code), column in zip(names, header.properties, table.T, strict=True):
            columns[name] = as_declared(column, code) if name in COLOURS else column
        yield columns
    if header.is_last:
        refuse_more(path, lines, header.count)
