"""Readers of trajectories alone, TUM and KITTI text; the formats themselves are in `trajectories.text`."""

from __future__ import annotations

from pathlib import Path

from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from hodge_adapters.text_rows import first_text, separator_of, to_floats
from hodge_adapters.trajectories.text import COLUMNS, decimal_commas, parse_tum, read_kitti
from hodge_pipeline.stages import Sniff
from hodge_pipeline.types import Source

SNIFFED_LINES = 40
SNIFFED_BYTES = 1 << 14
"""The head of a file, where the lines of a format show themselves."""


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class TumPosesReader:
    """Opens a file of `stamp tx ty tz qx qy qz qw` lines as a trajectory."""

    def sniff(self, path: Path) -> Sniff:
        """By the first lines that are no comment: eight numbers each."""
        return _sniff_columns(Path(path), COLUMNS, "lines of eight numbers")

    def open(self, path: Path) -> Source:
        """The trajectory, ascending; lines that are no pose are left out and noted."""
        parsed = parse_tum(Path(path))
        return Source(
            Path(path).stem, Path(path), trajectory=parsed.trajectory, notes=parsed.notes, files=(Path(path),)
        )


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class KittiPosesReader:
    """Opens a file of twelve numbers a line as a trajectory."""

    times: str = Field("", description="file beside it with one stamp in seconds a line; empty: stamps are row numbers")

    def sniff(self, path: Path) -> Sniff:
        """By the first lines: twelve numbers each."""
        return _sniff_columns(Path(path), (12,), "lines of twelve numbers")

    def open(self, path: Path) -> Source:
        """The trajectory."""
        path = Path(path)
        times = path.parent / self.times if self.times else None
        files = (path, times) if times else (path,)
        return Source(path.stem, path, trajectory=read_kitti(path, times), files=files)


def first_rows(path: Path) -> list[list[str]]:
    """The fields of the first lines that are no comment, cut at blanks, none where it cannot be read.

    A last line that does not end may be cut: it counts only where it is the only one.
    """
    *lines, last = first_text(path, SNIFFED_BYTES).split("\n")
    rows = [row for line in lines if (row := line.split("#", 1)[0].split())] or [last.split("#", 1)[0].split()]
    return [row for row in rows[:SNIFFED_LINES] if row]


def _sniff_columns(path: Path, counts: tuple[int, ...], what: str) -> Sniff:
    if advice := decimal_commas(path):
        return Sniff(0.0, f"no {what}", advice)
    lines = map(" ".join, first_rows(path))
    rows = [to_floats(line.replace(separator_of(line), " ").split()) for line in lines]
    rows = rows[1:] if rows and rows[0] is None else rows  # a head without a mark of comment
    good = sum(row is not None and len(row) in counts for row in rows)
    if not good or good < 0.8 * len(rows):
        return Sniff(0.0, f"no {what}")
    return Sniff(0.7, what)
