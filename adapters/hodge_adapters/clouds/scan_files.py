"""Scans as surveyors keep them: LAS and LAZ with `laspy`, E57 with `pye57`. Both packages are asked for when needed."""

from __future__ import annotations

import importlib
import os
import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hodge_adapters.clouds.columns import COLOURS, MAX_METRES, ROWS_IN_PART, ZERO, Columns, Corner, parts_of
from hodge_pipeline import se3
from hodge_pipeline.errors import SourceError
from hodge_pipeline.types import Floats
from hodge_pipeline.types.input_files import open_input

LIBRARIES = {".las": "laspy", ".laz": "laspy", ".e57": "pye57"}
MAX_POINTS = 1 << 28
"""A file that says more would fill 3 GB with one cloud."""
MAX_POINTS_A_BYTE, ALWAYS_POINTS = 4, 1 << 20
"""LAZ and E57 store a scanner's points in 1 to 20 bytes each, equal ones in next to none: more points than this for
each byte of a file, past the first million, are no scan."""

FIRST_POINTS = 1000
"""Of a LAS file, to compare with its header: less than LAZ decompresses at once (50,000)."""
LAS_TIME = "gps_time"
"""Read of files of one part at most: no sweep has more points, and the times of a survey take as much as these."""
LAS_HEADER, LAS_14_HEADER = 227, 375
"""Bytes of the public header of LAS 1.2 and 1.4 (ASPRS LAS 1.4 R15, tables 3 and 20)."""
RECORD_HEADER, EXTENDED_RECORD_HEADER = 54, 60
E57_HEADER, E57_PAGE, MAX_XML_BYTES = 48, 1024, 1 << 26
"""Bytes of the file header, of a page with its checksum (ASTM E2807, 8.3), and of the XML of ten thousand scans."""
E57_POINTS = ("cartesianX", "cartesianY", "cartesianZ")
E57_COLOURS = ("colorRed", "colorGreen", "colorBlue")
E57_INVALID = "cartesianInvalidState"
E57_NAMES = dict(zip((*E57_POINTS, *E57_COLOURS), (*"xyz", *COLOURS), strict=True))
E57_FIELDS = dict.fromkeys(E57_POINTS, np.float64) | dict.fromkeys(E57_COLOURS, np.float32) | {E57_INVALID: np.int8}
"""Colours are integers of any width or fractions (ASTM E2807, 8.4.4): float32 holds 8 and 16 bits exactly."""


@dataclass(frozen=True)
class Scan:
    """One scan of an E57 file: its row there, and `world_from_scan` (4, 4) where the file gives it."""

    row: int
    world_from_scan: Floats | None


def las_corner(paths: Sequence[Path], units_per_metre: float, *, is_all: bool) -> Corner | None:
    """The whole metres in the middle of those of these files that can be opened, in their units; zero where zero is
    nearer to them than they are large: these are in a scanner's axes.

    None where there is no such file; `is_all`: raises `SourceError` then, since no other file is there to be read.
    """
    corners, fault = [], None
    for path in paths:
        try:
            with _named(path, "laspy"), _opened_las(path) as file:
                _check_points(path, file.header.point_count)
                if file.header.point_count:  # an empty tile's header has zeros
                    corners.append(_las_box(file))
        except SourceError as error:  # said again where the cloud is read
            fault = error
    if not corners:
        if fault is not None and is_all:
            raise fault
        return None
    low, high = np.min(corners, axis=0)[0], np.max(corners, axis=0)[1]
    if not np.isfinite([low, high]).all():
        raise SourceError(f"{paths[0]}: the header's corner is not finite: mend it, or convert the file to PLY")
    if (np.maximum(low, -high) <= np.max(high - low)).all():
        return ZERO
    x, y, z = (units_per_metre * np.round((low + high) / 2 / units_per_metre)).tolist()
    return x, y, z


def _las_box(file: Any) -> Floats:
    """The lowest and highest coordinates (2, 3) that the header says, unless most of the first points lie outside: some
    software writes zeros there, or the integers that are stored. Then those of the first part.
    """
    said = np.array([file.header.mins, file.header.maxs], float)
    points = _coordinates(file.read_points(FIRST_POINTS))
    outside = ~((points > said[0] - 1) & (points < said[1] + 1)).all(axis=1)  # of a corner in whole metres
    if 2 * outside.sum() <= len(points):
        return said
    points = np.concatenate([points, _coordinates(file.read_points(ROWS_IN_PART))])
    return np.stack([points.min(axis=0), points.max(axis=0)])


def _coordinates(part: Any) -> Floats:
    return np.column_stack([np.asarray(part[axis], float) for axis in "xyz"])


def _check_counts(path: Path) -> None:
    """Raise `ValueError` where the header of a LAS file counts more records than the file has bytes for.

    laspy would go on looking for billions of them.
    """
    with open_input(path) as file:
        header, size = file.read(LAS_14_HEADER), os.fstat(file.fileno()).st_size
    if len(header) < LAS_HEADER or header[:4] != b"LASF":
        return  # laspy has the words for it
    points_at, records = struct.unpack_from("<II", header, 96)
    extended = struct.unpack_from("<I", header, 243)[0] if header[25] >= 4 and len(header) == LAS_14_HEADER else 0
    if points_at > size or RECORD_HEADER * records > points_at or EXTENDED_RECORD_HEADER * extended > size:
        raise ValueError(f"counts {records} and {extended} records, points from byte {points_at} of {size} on")


def las_parts(path: Path) -> Iterator[Columns]:
    """The points of a LAS or LAZ file as columns, in parts."""
    with _named(path, "laspy"), _opened_las(path) as file:
        said, found = file.header.point_count, 0
        _check_points(path, said)
        for part in _las_chunks(file):
            found += len(part)
            yield _las_columns(part, said <= ROWS_IN_PART)
        if found < said:  # laspy is content with those that are there
            raise SourceError(f"{path}: says {said} points, has {found}: copy it again")


def _opened_las(path: Path) -> Any:
    package = library("laspy", path)
    _check_counts(path)
    file = package.open(open_input(path), closefd=True)
    scales, offsets = np.asarray(file.header.scales, float), np.asarray(file.header.offsets, float)
    if not (np.isfinite(scales) & (scales != 0) & (np.abs(offsets) < MAX_METRES)).all():
        file.close()
        raise ValueError(f"scales {scales.tolist()} and offsets {offsets.tolist()} of its coordinates")
    return file


def _check_points(path: Path, count: int) -> None:
    """Raise `ValueError` for more points than a file of this size may hold."""
    if not 0 <= count <= min(MAX_POINTS, ALWAYS_POINTS + MAX_POINTS_A_BYTE * path.stat().st_size):
        raise ValueError(f"says {count} points in {path.stat().st_size} bytes")


def _las_chunks(file: Any) -> Iterator[Any]:
    if not file.header.point_count:
        yield file.read()
        return
    yield from file.chunk_iterator(ROWS_IN_PART)


def _las_columns(part: Any, is_sweep: bool) -> Columns:
    wanted = (*COLOURS, LAS_TIME) if is_sweep else COLOURS
    names = (*"xyz", *({*wanted} & {*part.point_format.dimension_names}))
    return {name: np.asarray(part[name]) for name in names}


def e57_scans(path: Path) -> list[Scan]:
    """The scans of an E57 file, by their headers."""
    scans = []
    with _named(path, "pye57"):
        file = _opened_e57(path)
        for row in range(file.scan_count):
            header = file.get_header(row)
            _check_points(path, header.point_count)
            pose = se3.from_parts(header.rotation_matrix, header.translation) if header.has_pose() else None
            if pose is not None and not se3.is_motion(pose):
                raise ValueError(f"the pose of scan {row} is no rigid motion")
            scans.append(Scan(row, pose))
    if not scans:
        raise SourceError(f"{path}: holds no scan: give a file with points")
    return scans


def e57_parts(path: Path, row: int = 0) -> Iterator[Columns]:
    """The points of one scan of an E57 file as columns, in parts, in the scanner's axes."""
    with _named(path, "pye57"):
        file = _opened_e57(path)
        _check_points(path, file.get_header(row).point_count)
        columns = _e57_columns(file, row)
    yield from parts_of(columns)


def _e57_columns(file: Any, row: int) -> dict[str, Any]:
    """The valid points of a scan and their colours, and nothing else: pye57 refuses what it has no type for, such as
    stamps and normals, and colours of 16 bits in its own buffers.
    """
    header, libe57 = file.get_header(row), importlib.import_module("pye57.libe57")
    if not {*E57_POINTS} <= {*header.point_fields}:
        raise ValueError(f"scan {row} has {', '.join(header.point_fields)}, not {', '.join(E57_POINTS)}")
    wanted = E57_FIELDS if {*E57_COLOURS} <= {*header.point_fields} else E57_FIELDS.keys() - {*E57_COLOURS}
    scan = {field: np.empty(header.point_count, E57_FIELDS[field]) for field in wanted if field in header.point_fields}
    buffers = libe57.VectorSourceDestBuffer()
    for field, values in scan.items():
        buffers.append(libe57.SourceDestBuffer(file.image_file, field, values, len(values), True, True))
    header.points.reader(buffers).read()
    good = scan.pop(E57_INVALID, np.zeros(header.point_count, np.int8)) == 0
    return {E57_NAMES[field]: values[good] for field, values in scan.items()}


def _opened_e57(path: Path) -> Any:
    """The file, once its XML is seen to define no entities: a few hundred bytes of them expand to gigabytes."""
    package = library("pye57", path)
    with open_input(path) as file:
        _, _, _, _, start, length, page = struct.unpack("<8sIIQQQQ", file.read(E57_HEADER))
        if page != E57_PAGE or length > MAX_XML_BYTES:
            raise ValueError(f"pages of {page} bytes, {length} bytes of XML")
        file.seek(start - start % page)
        pages = file.read(length + length // 64 + 2 * page)
    # Each page ends in four bytes of checksum, which may stand in the midst of a word.
    xml = b"".join(pages[at : at + page - 4] for at in range(0, len(pages), page))[start % page :][:length]
    if b"<!DOCTYPE" in xml or b"<!ENTITY" in xml or b"\0" in xml:
        raise ValueError("its XML defines entities, which no E57 does")
    return package.E57(str(path))


def library(name: str, path: Path) -> Any:
    """The package of this name; `SourceError` says how to get it."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise SourceError(f"{path}: needs the package {name}: pip install {name}, or convert it to PLY") from error


class _named:
    """Turns whatever a package raises into one line that names the file: its errors are of many kinds."""

    def __init__(self, path: Path, package: str) -> None:
        self.path, self.package = path, package

    def __enter__(self) -> None:
        return None

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: object) -> None:
        is_fault = isinstance(error, Exception) or type(error).__name__ == "PanicException"  # of laspy's Rust
        if is_fault and not isinstance(error, SourceError):
            if self.path.is_file() and not self.path.stat().st_size:
                raise SourceError(f"{self.path}: the file is empty: copy it again") from error
            words = " ".join(str(error).split())[:200] or type(error).__name__
            advice = "convert it to PLY, or copy it again if it is cut off"
            raise SourceError(f"{self.path}: {self.package} cannot read it ({words}): {advice}") from error
