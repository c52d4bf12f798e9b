"""Trajectories as text: TUM (`stamp tx ty tz qx qy qz qw`) and KITTI (twelve numbers, the top of a 4x4 matrix)."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass as plain_dataclass
from pathlib import Path

import numpy as np
from pydantic import ConfigDict
from pydantic.dataclasses import dataclass

from hodge_adapters.posed import length_notes, trajectory_of, written
from hodge_adapters.text_rows import DECIMAL_ROW, Row, first_text, listed, read_rows, to_floats, write_text_atomically
from hodge_pipeline import se3
from hodge_pipeline.errors import SourceError
from hodge_pipeline.types import Floats, Source, Trajectory
from hodge_pipeline.types.text import counted

COLUMNS = (8, 9)
"""Of a line of TUM's: RTAB-Map adds the number of the node."""
_QUATERNION = re.compile(r"\bq_?(?:RS_)?([wx])\b", re.IGNORECASE)
"""As TUM, and as EuRoC spell it."""

NO_QUATERNION = 0.1
"""So far from 1 is the length of none that is written with one decimal or more."""

ELSEWHERE, TWO_PATHS, FEW = 3.0, 0.1, 2
"""Times the length that nine in ten steps stay below, from which a pose of a repeated stamp is another's, as rounded
stamps repeat within a step or two; and the share and the number of such poses up to which it is a path with mistakes.
"""

UNITS = (("nanoseconds", 1e17, 1e9), ("microseconds", 1e14, 1e6), ("milliseconds", 1e11, 1e3))
"""What all stamps from so much on count, and how many make a second: as seconds 1e11 is the year 5138."""

LATEST_STAMP = 2.0**62
"""The year 2116 in nanoseconds: no clock says more, and every whole number below it is a frame's or a vertex's."""


def is_stamp(value: float) -> bool:
    """Whether a number can be a time or a frame's number, in whatever unit."""
    return abs(value) < LATEST_STAMP  # which NaN is not


def unit_of(stamps: Floats) -> tuple[str, float]:
    """What the stamps of one file count, and how many make a second: ORB-SLAM3, among others, writes nanoseconds since
    1970. Numbers of which some are small are seconds, or no time at all.
    """
    least = stamps.min(initial=np.inf)
    known = ((name, per_second) for name, smallest, per_second in UNITS if smallest <= least < np.inf)
    return next(known, ("seconds", 1.0))


def in_seconds(stamps: Floats, name: str, notes: list[str]) -> Floats:
    """The stamps of one file in seconds; where it counts another unit, that is noted."""
    unit, per_second = unit_of(stamps)
    if per_second > 1:
        notes.append(f"{name}: stamps are read as {unit}, too large for seconds")
    return stamps / per_second


@plain_dataclass(frozen=True)
class ParsedTrajectory:
    """A trajectory, and what had to be left out or put in order to read it, one line each."""

    trajectory: Trajectory
    notes: tuple[str, ...]


def parse_tum(path: Path) -> ParsedTrajectory:
    """The trajectory in a TUM file, ascending by stamp in seconds; of poses with the same stamp the first is kept.

    Lines that are no pose are left out and noted. Raises `SourceError` where no pose is left.
    """
    table, bad = _tum_table(_rows_with_points(path))
    if not len(table):
        raise _unreadable(path, bad, "stamp tx ty tz qx qy qz qw")
    notes: list[str] = []
    table[:, 0] = in_seconds(table[:, 0], path.name, notes)
    w_first = has_w_first(path)
    if w_first:
        table[:, 4:] = np.roll(table[:, 4:], -1, axis=1)
    refuse_other_columns(table, path)
    refuse_two_paths(table, path)
    parsed = ordered(table)
    notes += [f"{path.name}: {note}" for note in parsed.notes]
    if w_first:
        notes.append(f"{path.name}: quaternions are read with w first, as its head names them")
    if bad:
        notes.append(
            f"{path.name}: {counted(len(bad), 'line that is|lines that are')} no pose left out: "
            f"{listed([r.line for r in bad])}"
        )
    return ParsedTrajectory(parsed.trajectory, tuple(notes))


def decimal_commas(path: Path) -> str:
    """What to do with a file whose first lines have commas for decimal points; "" where they have none."""
    rows = (line.split("#", 1)[0].replace(";", " ") for line in first_text(path).splitlines())
    if not any("," in row and DECIMAL_ROW.fullmatch(row) for row in rows):
        return ""
    return "its numbers have decimal commas: write points, by tr ',;' '. ' < FILE > NEW, and give the new file"


def _rows_with_points(path: Path) -> list[Row]:
    """The rows of a file. Raises `SourceError` for decimal commas, which `read_rows` would cut numbers at."""
    if advice := decimal_commas(path):
        raise SourceError(f"{path}: {advice}")
    return read_rows(path)


def has_w_first(path: Path) -> bool:
    """Whether the head of a TUM file names qw before qx, unlike TUM."""
    return first_of_quaternion(first_text(path)) == "w"


def first_of_quaternion(head: str) -> str | None:
    """Which of w and x a head names first, None where it names neither."""
    named = _QUATERNION.search(head)
    return named[1].lower() if named else None


def tum_stamps(path: Path) -> Floats:
    """The stamps (N,) in a TUM file, as it writes them."""
    return _tum_table(read_rows(path))[0][:, 0]


def write_tum(path: Path, trajectory: Trajectory) -> None:
    """One line a pose, `stamp tx ty tz qx qy qz qw`, every number with the digits that restore it exactly."""
    poses = trajectory.world_from_cam
    table = np.column_stack([trajectory.stamps_s, poses[:, :3, 3], se3.to_quat_xyzw(poses)])
    write_text_atomically(path, "# stamp tx ty tz qx qy qz qw\n" + _lines(table))


def read_kitti(path: Path, times: Path | None = None) -> Trajectory:
    """The trajectory in a KITTI file; its stamps are the row numbers, or those of a file with one stamp a line.

    Rotations are projected to SO(3) (the files hold few digits). Raises `SourceError` with `file:line`.
    """
    rows = _rows_with_points(path)
    numbers = [to_floats(row.fields) for row in rows]
    bad = [row for row, values in zip(rows, numbers, strict=True) if not values or len(values) != 12]
    if bad or not rows:
        raise _unreadable(path, bad, "twelve numbers, the first three rows of a 4x4 matrix")
    poses = np.zeros((len(rows), 4, 4))
    poses[:, :3] = np.array(numbers).reshape(-1, 3, 4)
    poses[:, 3, 3] = 1.0
    wrong = np.flatnonzero(~se3.is_motion(poses))
    if len(wrong):
        raise SourceError(f"{path}:{rows[wrong[0]].line}: not a rigid motion: is this a KITTI pose file?")
    poses[:, :3, :3] = se3.project_to_so3(poses[:, :3, :3])
    stamps_s = _read_times(times, len(rows)) if times else np.arange(len(rows), dtype=float)
    return Trajectory(stamps_s, poses, has_stamps=times is not None)


def write_kitti(path: Path, trajectory: Trajectory) -> None:
    """One line a pose, twelve numbers. The stamps are lost: KITTI keeps them in another file."""
    write_text_atomically(path, _lines(trajectory.world_from_cam[:, :3].reshape(-1, 12)))


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class TumWriter:
    """Writes a trajectory as TUM text."""

    def write(self, path: Path, source: Source) -> tuple[str, ...]:
        """One file, atomically; see `write_tum`."""
        trajectory = trajectory_of(source)
        write_tum(path, trajectory)
        return written(counted(len(trajectory), "pose"), source, {"stamps"})


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class KittiWriter:
    """Writes a trajectory as KITTI text."""

    def write(self, path: Path, source: Source) -> tuple[str, ...]:
        """One file, atomically; see `write_kitti`."""
        trajectory = trajectory_of(source)
        write_kitti(path, trajectory)
        return written(counted(len(trajectory), "pose"), source)


def _lines(table: Floats) -> str:
    # repr is the shortest text that reads back as the same double; adding 0 turns -0.0 into 0.0.
    return "".join(" ".join(map(repr, row)) + "\n" for row in (table + 0.0).tolist())


def _tum_table(rows: Sequence[Row]) -> tuple[Floats, list[Row]]:
    """The poses (N, 8) in the file's order, and the rows that are none."""
    good: list[list[float]] = []
    bad: list[Row] = []
    for row in rows:
        values = to_floats(row.fields) or []
        sound = len(values) in COLUMNS and is_stamp(values[0]) and all(abs(value) < se3.MAX_NUMBER for value in values)
        if sound and 1e-100 < math.hypot(*values[4:8]) < 1e100:  # beyond these the square is no normal number
            good.append(values[:8])
        else:
            bad.append(row)
    return np.array(good, np.float64).reshape(-1, 8), bad


def refuse_other_columns(table: Floats, path: Path) -> None:
    """Raise `SourceError` where no row (N, 8) `stamp tx ty tz qx qy qz qw` ends in a quaternion."""
    lengths = np.linalg.norm(table[:, 4:], axis=1)
    if (np.abs(lengths - 1) > NO_QUATERNION).all():
        raise SourceError(
            f"{path}: no quaternion has a length near 1, the first {lengths[0]:.4g}: other columns, such as an index "
            "before the stamp, stand in its place: remove them"
        )


def refuse_two_paths(table: Floats, path: Path) -> None:
    """Raise `SourceError` where many rows (N, 8) repeat a stamp, yet lie elsewhere than its first pose."""
    _, first, again = np.unique(table[:, 0], return_index=True, return_inverse=True)
    places = table[:, 1:4]
    steps = np.linalg.norm(np.diff(places[first], axis=0), axis=1)
    usual = float(np.quantile(steps, 0.9)) if len(steps) else 0.0
    elsewhere = np.linalg.norm(places - places[first][again], axis=1) > ELSEWHERE * usual
    if (count := int(elsewhere.sum())) > max(TWO_PATHS * len(table), FEW):
        raise SourceError(
            f"{path}: {count} poses have the stamp of an earlier one and lie elsewhere: two sessions or two cameras? "
            "Give each in a file of its own"
        )


def ordered(table: Floats) -> ParsedTrajectory:
    """The trajectory of rows (N, 8) `stamp tx ty tz qx qy qz qw`, ascending; of equal stamps the first is kept."""
    stamps, first = np.unique(table[:, 0], return_index=True)
    notes = []
    if len(stamps) < len(table):
        notes.append(f"{counted(len(table) - len(stamps), 'pose')} with the stamp of an earlier one left out")
    if (np.diff(table[:, 0]) < 0).any():
        notes.append("poses were not in order of time: sorted")
    notes += length_notes(table[:, 4:], "poses")
    poses = se3.from_quat_xyzw(table[first, 1:4], table[first, 4:])
    return ParsedTrajectory(Trajectory(stamps, poses), tuple(notes))


def _read_times(path: Path, count: int) -> Floats:
    rows = read_rows(path)
    values = [to_floats(row.fields[:1]) for row in rows]
    stamps = np.array([value[0] for value in values if value])
    if len(stamps) != count or not np.isfinite(stamps).all() or (np.diff(stamps) <= 0).any():
        raise SourceError(f"{path}: {len(stamps)} stamps for {count} poses, or not ascending: give one stamp a pose")
    return stamps


def _unreadable(path: Path, bad: Sequence[Row], expected: str) -> SourceError:
    if not bad:
        return SourceError(f"{path}: no pose in it: expected lines of {expected}")
    fields = bad[0].fields
    shown = f"`{' '.join(fields)[:80]}` of {counted(len(fields), 'column')}"
    return SourceError(f"{path}:{bad[0].line}: {shown} is no pose: expected {expected}")
