"""A point cloud of named columns, as point-cloud files hold them: taken in parts, so that memory holds little twice."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import islice
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from hodge_adapters.text_rows import to_floats
from hodge_pipeline.errors import SourceError
from hodge_pipeline.types import Bools, Bytes, Floats, Floats32, PointCloud
from hodge_pipeline.types.positions import whole_kilometres

NORMALS = (("nx", "ny", "nz"), ("normal_x", "normal_y", "normal_z"))
COLOURS = ("red", "green", "blue")
OTHER_NAMES = {
    "diffuse_red": "red",
    "diffuse_green": "green",
    "diffuse_blue": "blue",
    "r": "red",
    "g": "green",
    "b": "blue",
}
PACKED = ("rgb", "rgba")
"""Colours of four bytes, 0xAARRGGBB, declared as a float by PCL's convention."""
UNITS_S = (1.0, 1e-3, 1e-6, 1e-9)
TIMES = dict.fromkeys(
    ("t", "time", "timestamp", "offsettime", "timeoffset", "ts", "relativetime", "pointtime", "stamp"), UNITS_S
) | {"tus": (1e-6,), "gpstime": (1.0,)}
"""When a point was measured, by names without case and underscores, and the units that each may be counted in: drivers
of Ouster, Velodyne, Hesai and Livox, and programs after them, name it differently. LAS counts seconds."""
REVOLUTION_S = (0.01, 2.0)
"""A spinning scanner's: it tells seconds from milli-, micro- and nanoseconds."""
NAMES = frozenset((*"xyz", *COLOURS, *PACKED, *NORMALS[0], *NORMALS[1]))
MAX_METRES = 1e9
"""A point with a coordinate beyond counts as one without numbers: no map of the Earth has it."""
COARSE_M = 1e-3
"""Steps of coordinates from which on they hide what a terrestrial scanner measures; 32 bits have them beyond 16 km."""
ROWS_IN_PART, LINES_IN_PART = 1 << 20, 1 << 17
"""Read at once: so a file of any length takes some tens of megabytes."""
Columns: TypeAlias = Mapping[str, Any]
Corner: TypeAlias = tuple[float, float, float]
ZERO: Corner = (0.0, 0.0, 0.0)


def points_of_columns(path: Path, columns: Columns) -> PointCloud:
    """The cloud of the points that are finite. Raises `SourceError` where x, y or z is missing."""
    return points_of_parts(path, parts_of(columns))


def points_of_parts(path: Path, parts: Iterable[Columns], corner: Corner = ZERO) -> PointCloud:
    """The cloud of columns that come in parts, at least one, all with the same names, counted from a corner: float32
    has no room for map coordinates.
    """
    points: list[Floats32] = []
    normals: list[Floats32] = []
    colours: list[NDArray[Any]] = []
    times: dict[str, list[Floats]] = {}
    no_numbers = 0
    for columns in parts:
        if not all(name in columns for name in "xyz"):
            raise SourceError(f"{path}: no x, y and z among {', '.join(columns) or 'nothing'}: give a file of points")
        found = _stack(columns, "xyz", corner)
        with np.errstate(invalid="ignore"):
            finite: Bools = np.asarray((np.abs(found) < MAX_METRES).all(axis=1))
        points.append(found[finite])
        no_numbers += len(found) - len(points[-1])
        names = next((names for names in NORMALS if names[0] in columns), None)
        if names:
            normals.append(_unit(_stack(columns, names)[finite]))
        if all(name in columns for name in COLOURS):
            colours.append(_raw_colours(columns, finite))
        for name in filter(is_time, columns):
            times.setdefault(name, []).append(np.asarray(columns[name][finite], float))
    joined = _joined(points)
    times_s, first_s = _times_of({name: _joined(parts) for name, parts in times.items()}, joined.any(axis=1))
    return PointCloud(
        joined,
        _joined(normals) if normals else None,
        _eight_bits(_joined(colours)) if colours else None,
        times_s=times_s,
        first_s=first_s,
        no_numbers=no_numbers,
    )


def columns_called(names: Sequence[str]) -> list[str]:
    """What columns are called here: those of coordinates, normals and colours have these names in any case and some
    others (`X`, `diffuse_red`), unless another column has the name itself.
    """
    known = [OTHER_NAMES.get(name.lower(), name.lower()) for name in names]
    return [ours if ours in NAMES and ours not in names else name for name, ours in zip(names, known, strict=True)]


def is_time(name: str) -> bool:
    """Whether a column of this name may hold when points were measured."""
    return _folded(name) in TIMES


def _folded(name: str) -> str:
    return name.lower().replace("_", "") if len(name) > 1 else name  # T is a temperature


def _times_of(columns: Mapping[str, Floats], returned: Bools) -> tuple[Floats32 | None, float]:
    """As `seconds_after_first` says, of the first of columns (N,), in the order of `TIMES`, that gives a revolution."""
    ranks = list(TIMES)
    for name in sorted(columns, key=lambda one: ranks.index(_folded(one))):
        times_s, first_s = seconds_after_first(columns[name], returned, TIMES[_folded(name)])
        if times_s is not None:
            return times_s, first_s
    return None, 0.0


def far_corner(columns: Columns, units_per_metre: float) -> Corner:
    """The corner to count the points of columns from: the whole metres of their middle, in the units of the columns,
    where they lie far from zero with more digits than float32 has; else zero.

    A scanner's reach, and with it the size of a sweep's voxels, is counted from there.
    """
    axes = [columns[axis] for axis in "xyz" if axis in columns]
    if len(axes) < 3 or np.result_type(np.float32, *axes) == np.float32:
        return ZERO
    points = _far_points(columns, units_per_metre)
    if not len(points):
        return ZERO
    x, y, z = (units_per_metre * np.round(np.median(points, axis=0) / units_per_metre)).tolist()
    return x, y, z


def coarse_step(columns: Columns, units_per_metre: float) -> float:
    """The step in metres to which the points of columns were rounded as 32-bit numbers far from zero, whatever type
    the columns have now; zero where they have more digits, or finer steps than `COARSE_M`.
    """
    points = _far_points(columns, units_per_metre)
    if not len(points) or not np.array_equal(points, points.astype(np.float32)):
        return 0.0
    step = float(np.spacing(np.float32(np.abs(np.median(points, axis=0)).max()))) / units_per_metre
    return step if step >= COARSE_M else 0.0


def _far_points(columns: Columns, units_per_metre: float) -> Floats:
    """The points of columns, in their units, where their middle is far from zero; else none."""
    if not all(axis in columns for axis in "xyz"):
        return np.zeros((0, 3))
    points = np.column_stack([np.asarray(columns[axis], float) for axis in "xyz"])
    with np.errstate(invalid="ignore"):
        points = points[(np.abs(points) < MAX_METRES).all(axis=1)]
    return points if whole_kilometres(points / units_per_metre).any() else np.zeros((0, 3))


def unpacked(columns: dict[str, Any]) -> dict[str, Any]:
    """The columns with those of packed colours unpacked, unless they have colours already."""
    packed = next((name for name in PACKED if name in columns and columns[name].dtype.itemsize == 4), None)
    if packed is None or all(name in columns for name in COLOURS):
        return columns
    words = np.ascontiguousarray(columns[packed])
    words = words.view(np.dtype("u4").newbyteorder(words.dtype.byteorder))
    return columns | {name: (words >> by & 255).astype(np.uint8) for name, by in zip(COLOURS, (16, 8, 0), strict=True)}


def as_declared(column: Floats, code: str) -> NDArray[Any]:
    """A column of numbers that were text, in the type that its header declares; what that has no room for is cut."""
    kind = np.dtype(code)
    with np.errstate(over="ignore", invalid="ignore"):
        if kind.kind in "iu":
            column = np.clip(column, np.iinfo(kind).min, np.iinfo(kind).max)
        return np.ascontiguousarray(column.astype(kind))


def seconds_after_first(
    times: Floats, returned: Bools, units_s: Sequence[float] = UNITS_S
) -> tuple[Floats32 | None, float]:
    """When each point (N,) was measured, seconds after the first, and when that was, whatever unit a revolution is
    counted in; none where no unit gives a revolution. Points that did not return may have any time: they get 0.
    """
    told = times[returned]
    if not len(told) or not np.isfinite(told).all():
        return None, 0.0
    first, last = float(told.min()), float(told.max())
    for unit in units_s:
        # Two moments are no revolution: float32 counts seconds since 1970 in steps of two minutes.
        if REVOLUTION_S[0] <= (last - first) * unit <= REVOLUTION_S[1] and ((told > first) & (told < last)).any():
            return np.where(returned, (times - first) * unit, 0).astype(np.float32), first * unit
    return None, 0.0


def number_rows(path: Path, lines: Iterable[bytes], count: int, width: int) -> Iterator[Floats]:
    """The first `count` lines as tables (n, width) of numbers, in parts, at least one; `SourceError` where there are
    fewer, or others.
    """
    left, found = iter(lines), 0
    while found < count or not found:
        part = list(islice(left, wanted := min(LINES_IN_PART, count - found)))
        try:
            table = np.array(b" ".join(part).split(), np.float64).reshape(-1, width or 1)
        except ValueError as error:
            raise _wrong_row(path, part, found, width) from error
        if len(table) != wanted:
            if len(part) == wanted:
                raise _wrong_row(path, part, found, width)
            raise SourceError(f"{path}: says {count} points, has {found + len(table)}: copy it again")
        found += len(table)
        yield table
        if not count:
            return


def refuse_more(path: Path, lines: Iterable[bytes], count: int) -> None:
    """Raise `SourceError` where lines are left after those of `count` points."""
    if rest := sum(1 for _ in lines):
        raise SourceError(f"{path}: says {count} points, has {count + rest}: copy it again")


def _wrong_row(path: Path, part: list[bytes], before: int, width: int) -> SourceError:
    """The error that names the first line of a part which is no row of `width` numbers."""
    texts = ((row, line.decode("utf-8", "replace").split()) for row, line in enumerate(part, before + 1))
    row, words = next((row, words) for row, words in texts if len(words) != width or to_floats(words) is None)
    return SourceError(f"{path}: point {row}, `{' '.join(words)[:60]}`, is no row of {width} numbers: mend its line")


def parts_of(columns: Columns) -> Iterator[dict[str, Any]]:
    """Columns of any length, in parts, at least one."""
    count = max((len(column) for column in columns.values()), default=0)
    for start in range(0, max(count, 1), ROWS_IN_PART):
        yield {name: column[start : start + ROWS_IN_PART] for name, column in columns.items()}


def _joined(parts: list[Any]) -> Any:
    """The parts one after the other; the list is emptied, so that their memory is free before more is taken."""
    whole = parts[0] if len(parts) == 1 else np.concatenate(parts)
    parts.clear()
    return whole


def _stack(columns: Columns, names: str | tuple[str, ...], corner: Corner = ZERO) -> Floats32:
    out = np.zeros((len(columns[names[0]]), len(names)), np.float32)
    with np.errstate(over="ignore", invalid="ignore"):
        for at, name in enumerate(names):
            if name in columns:
                out[:, at] = columns[name] - corner[at] if corner[at] else columns[name]
    return out


def _unit(normals: Floats32) -> Floats32:
    """Unit normals, zero where there is none."""
    with np.errstate(over="ignore", invalid="ignore"):
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        good = np.isfinite(length) & (length > 1e-6)
        return np.where(good, normals / np.where(good, length, 1), np.float32(0)).astype(np.float32)


def _raw_colours(columns: Columns, finite: Bools) -> NDArray[Any]:
    """The colours of a part: what decides between fractions, 8 and 16 bits is the largest of all parts."""
    values = np.column_stack([columns[name] for name in COLOURS])[finite]
    if values.dtype.kind == "f":
        return values.astype(np.float32)
    return values if values.dtype == np.uint8 else np.clip(values, 0, 65535).astype(np.uint16)


def _eight_bits(values: NDArray[Any]) -> Bytes:
    if values.dtype == np.uint8:
        return values
    largest = np.nanmax(values) if values.size else 0
    if largest >= 256:
        values = values // 257
    elif values.dtype.kind == "f" and largest <= 1:
        values = values * np.float32(255)
    colours: Bytes = np.nan_to_num(np.clip(values, 0, 255)).astype(np.uint8)
    return colours
