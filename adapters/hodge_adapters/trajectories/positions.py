"""Tables of known positions: a row for each frame by its name or its stamp, in metres or in degrees, with sigma."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from pydantic import ConfigDict
from pydantic.dataclasses import dataclass

from hodge_adapters.text_rows import Row, first_text, listed, read_text
from hodge_pipeline.errors import SourceError
from hodge_pipeline.stages import Sniff
from hodge_pipeline.types import Bools, Floats, Ints, Source, Words
from hodge_pipeline.types.positions import Positions, from_geodetic
from hodge_pipeline.types.text import counted

SPELLINGS = {
    "name": ("name", "image", "image_name", "file", "filename", "frame", "id", "label"),
    "stamp": ("stamp", "time", "timestamp", "stamp_s", "time_s", "t", "seconds"),
    "e": ("e", "east", "easting", "x", "e_m", "x_m"),
    "n": ("n", "north", "northing", "y", "n_m", "y_m"),
    "u": ("u", "up", "z", "u_m", "z_m"),
    "lat": ("lat", "latitude", "latitude_deg"),
    "lon": ("lon", "lng", "long", "longitude", "longitude_deg"),
    "alt": ("alt", "altitude", "height", "ele", "elevation", "altitude_m", "h"),
    "sigma": ("sigma", "sigma_m", "accuracy", "std"),
    "sigma_e": ("sigma_e", "sigma_x", "std_e", "std_x", "sde"),
    "sigma_n": ("sigma_n", "sigma_y", "std_n", "std_y", "sdn"),
    "sigma_u": ("sigma_u", "sigma_z", "std_u", "std_z", "sdu"),
    **{f"cov_{pair}": (f"cov_{pair}", f"c{pair}") for pair in ("ee", "en", "eu", "nn", "nu", "uu")},
    "turned": ("qx", "qw", "q_x", "roll", "yaw"),
}
"""Names of a column, in small letters, as tables of GNSS receivers and of photogrammetry have them."""
WANTED = "name or stamp (seconds), then e,n,u (metres) or lat,lon,alt (degrees, metres), then sigma (metres) if known"


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class PositionsReader:
    """Opens a table (CSV, or columns at blanks) of known positions; its first line names the columns."""

    def sniff(self, path: Path) -> Sniff:
        """By the first line: the names of a coordinate's three columns, and of a name or stamp."""
        path = Path(path)
        head = first_text(path).splitlines()
        try:
            rows = _rows(head[:1], path)
        except SourceError:
            rows = []
        if not rows or not _axes(_columns(rows[0].fields)):
            return Sniff(0.0, "no line that names columns of positions")
        return Sniff(0.8, "its first line names columns of positions")

    def open(self, path: Path) -> Source:
        """The positions; rows that hold none are left out and noted. Raises `SourceError` with `file:line`."""
        path = Path(path)
        notes: list[str] = []
        return Source(path.stem, path, positions=read_positions(path, notes), notes=tuple(notes), files=(path,))


def read_positions(path: Path, notes: list[str]) -> Positions:
    """The positions of a table, what is left out in the notes."""
    rows = _rows(read_text(path).lstrip("\ufeff").splitlines(), path)
    columns = _columns(rows[0].fields) if rows else {}
    axes = _axes(columns)
    if not axes:
        raise SourceError(f"{path}:1: the first line names no columns of positions: it should name {WANTED}")
    rows = rows[1:]
    table = {name: _numbers(path, rows, name, place) for name, place in columns.items() if name != "name"}
    points = np.stack([table[axis] for axis in axes], axis=1)
    names = np.array([_cell(row, columns.get("name")) for row in rows], str)
    stamps = table.get("stamp", np.full(len(points), np.nan))
    good = np.isfinite(points).all(axis=1) & ((names != "") | np.isfinite(stamps))
    if not good.all():
        lines = [row.line for row, fits in zip(rows, good, strict=True) if not fits]
        notes.append(
            f"{counted(len(lines), 'row')} without a name or stamp or three coordinates left out: line {listed(lines)}"
        )
    if not good.any():
        raise SourceError(f"{path}: no row has a name or stamp and three coordinates: give {WANTED}")
    kept = _firsts(names, stamps, good)
    if len(kept) < good.sum():
        lines = [rows[row].line for row in np.setdiff1d(np.flatnonzero(good), kept)]
        notes.append(
            f"{counted(len(lines), 'row')} with the name and stamp of an earlier one left out: line {listed(lines)}"
        )
    names, stamps = names[kept], stamps[kept]
    points, covariances = points[kept], _covariances(path, rows, table)[kept]
    if axes[0] == "lat":
        _check_degrees(path, points)
        return from_geodetic(points, covariances, names, stamps)
    return Positions(points, covariances, names, stamps).near_zero()


def _firsts(names: Words, stamps: Floats, good: Bools) -> Ints:
    """Of the good rows with the same name and stamp the first ones, ascending."""
    rows = np.flatnonzero(good)
    labels = np.array([f"{stamp} {name}" for name, stamp in zip(names[rows], stamps[rows], strict=True)])
    return np.sort(rows[np.unique(labels, return_index=True)[1]])


def _rows(lines: Sequence[str], path: Path) -> list[Row]:
    """The lines that hold any fields, cut as the first one is: at semicolons, tabs, commas or blanks.

    Raises `SourceError` with `file:line` where a quote is not closed.
    """
    kept = [(number, line) for number, line in enumerate(lines, 1) if line.strip()]
    head, kept = kept[:1], [row for row in kept[1:] if not row[1].startswith("#")]
    kept = [(number, line.lstrip("# ")) for number, line in head] + kept
    mark = next((mark for mark in ";\t," if kept and mark in kept[0][1]), None)
    if mark is None:
        return [Row(number, line.split()) for number, line in kept]
    return [Row(number, _cells(line, mark, f"{path}:{number}")) for number, line in kept]


def _cells(line: str, mark: str, where: str) -> list[str]:
    try:
        return [cell.strip() for cell in next(csv.reader([line], delimiter=mark, strict=True))]
    except csv.Error as error:
        raise SourceError(f"{where}: cannot be cut into cells ({error}): close its quote or mend the line") from error


def _columns(head: Sequence[str]) -> dict[str, int]:
    """The place of each column that is known, by its name here."""
    words = [word.strip().lower().split("[")[0].split("(")[0].strip() for word in head]
    return {
        name: words.index(found)
        for name, spellings in SPELLINGS.items()
        for found in [next((word for word in spellings if word in words), None)]
        if found is not None
    }


def _axes(columns: Mapping[str, int]) -> tuple[str, str, str] | None:
    """The columns of the three coordinates, where there are any, and rows say whose they are; none of whole poses."""
    if "turned" in columns or ("name" not in columns and "stamp" not in columns):
        return None
    triples = (("lat", "lon", "alt"), ("e", "n", "u"))
    return next((triple for triple in triples if all(axis in columns for axis in triple)), None)


def _cell(row: Row, place: int | None) -> str:
    return "" if place is None or place >= len(row.fields) else row.fields[place]


def _numbers(path: Path, rows: Sequence[Row], name: str, place: int) -> Floats:
    """A column of numbers (P,), NaN where a row has none."""
    values = np.full(len(rows), np.nan)
    for number, row in enumerate(rows):
        word = _cell(row, place)
        try:
            values[number] = float(word) if word else np.nan
        except ValueError as error:
            raise SourceError(f"{path}:{row.line}: {name} is {word!r}: expected a number") from error
    return values


def _covariances(path: Path, rows: Sequence[Row], table: Mapping[str, Floats]) -> Floats:
    """Covariances (P, 3, 3) that the columns state, NaN where they state none."""
    out = np.full((len(rows), 3, 3), np.nan)
    if "sigma" in table:
        out = table["sigma"][:, None, None] ** 2 * np.eye(3)
    if all(f"sigma_{axis}" in table for axis in "enu"):
        out = np.stack([table[f"sigma_{axis}"] for axis in "enu"], axis=1)[:, None, :] ** 2 * np.eye(3)
    if all(f"cov_{axis}{axis}" in table for axis in "enu"):
        zero = np.zeros(len(rows))
        cells = [[table.get(f"cov_{min(a, b)}{max(a, b)}", zero) for b in "enu"] for a in "enu"]
        out = np.moveaxis(np.array(cells), 2, 0)
    stated = np.isfinite(out).all(axis=(1, 2))
    out[~stated] = np.nan
    bad = stated & ~(np.linalg.eigvalsh(np.where(stated[:, None, None], out, np.eye(3)))[:, 0] > 0)
    if bad.any():
        line = rows[int(np.argmax(bad))].line
        raise SourceError(f"{path}:{line}: its sigma or covariance is not positive: mend it or leave it empty")
    return out


def _check_degrees(path: Path, geodetic: Floats) -> None:
    bad = (np.abs(geodetic[:, 0]) > 90) | (np.abs(geodetic[:, 1]) > 360)
    if bad.any():
        lat, lon = geodetic[int(np.argmax(bad)), :2]
        raise SourceError(f"{path}: latitude {lat:g}, longitude {lon:g} are no degrees: columns of metres are e,n,u")
