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

from hodge_adapters.clouds.columns import COLOURS, ROWS_IN_PART, ZERO, Columns, Corner, parts_of
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

LAS_TIME = "gps_time"
"""Read of files of one part at most: no sweep has more points, and the times of a survey take as much as these."""
LAS_HEADER, LAS_14_HEADER = 227, 375
"""Bytes of the public header of LAS 1.2 and 1.4 (ASPRS LAS 1.4 R15, tables 3 and 20)."""
RECORD_HEADER, EXTENDED_RECORD_HEADER = 54, 60
E57_HEADER, E57_PAGE, MAX_XML_BYTES = 48, 1024, 1 << 26
"""Bytes of the file header, of a page with its checksum (ASTM E2807, 8.3), and of the XML of ten thousand scans."""


@dataclass(frozen=True)
class Scan:
    """One scan of an E57 file: its row there, and `world_from_scan` (4, 4) where the file gives it."""

    row: int
    world_from_scan: Floats | None


def las_corner(paths: Sequence[Path], units_per_metre: float, *, is_all: bool = True) -> Corner | None:
    """The whole metres in the middle of those of these files that can be opened, in their units, from their headers;
    zero where zero is nearer to them than they are large: these are in a scanner's axes.

    None where there is no such file; `is_all`: raises `SourceError` then, since no other file is there to be read.
    """
    corners, fault = [], None
    for path in paths:
        try:
            with _named(path, "laspy"), _opened_las(path) as file:
                _check_points(path, file.header.point_count)
                corners.append(np.array([file.header.mins, file.header.maxs], float))
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
        _check_points(path, file.header.point_count)
        is_sweep = file.header.point_count <= ROWS_IN_PART
        yield from (_las_columns(part, is_sweep) for part in _las_chunks(file))


def _opened_las(path: Path) -> Any:
    package = library("laspy", path)
    _check_counts(path)
    return package.open(open_input(path), closefd=True)


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
        scan = file.read_scan_raw(row)
        good = np.asarray(scan.get("cartesianInvalidState", np.zeros(len(scan["cartesianX"])))) == 0
        columns = {name: np.asarray(scan[f"cartesian{name.upper()}"])[good] for name in "xyz"}
        if "colorRed" in scan:
            for name in ("Red", "Green", "Blue"):
                columns[name.lower()] = np.asarray(scan[f"color{name}"])[good]
    yield from parts_of(columns)


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
        if isinstance(error, Exception) and not isinstance(error, SourceError):
            words = " ".join(str(error).split())[:200] or type(error).__name__
            raise SourceError(f"{self.path}: {self.package} cannot read it ({words}): convert it to PLY") from error
