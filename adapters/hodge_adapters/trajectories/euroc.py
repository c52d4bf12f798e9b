"""EuRoC trajectories: CSV with stamps in nanoseconds, position, quaternion with w first; more columns may follow."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from pydantic import ConfigDict
from pydantic.dataclasses import dataclass

from hodge_adapters.posed import trajectory_of, written
from hodge_adapters.text_rows import Row, first_text, listed, read_text, to_floats, write_text_atomically
from hodge_adapters.trajectories.text import first_of_quaternion, ordered, refuse_other_columns, refuse_two_paths
from hodge_pipeline import se3
from hodge_pipeline.errors import SourceError
from hodge_pipeline.stages import Sniff
from hodge_pipeline.types import Source
from hodge_pipeline.types.text import counted

COLUMNS = 8
NANO = 1_000_000_000
MAX_STAMP_NS = 1 << 63
"""Stamps are read as whole numbers of 64 bits."""
HEADER = "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z []\n"


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class EurocReader:
    """Opens a EuRoC trajectory (`data.csv` of the ground truth, or an estimate in that form), or a folder with one."""

    def sniff(self, path: Path) -> Sniff:
        """By the first lines: EuRoC's header, or whole nanoseconds, then numbers with commas between."""
        text = first_text(file_of(Path(path)))
        w_first = first_of_quaternion(text) != "x"
        if w_first and any("timestamp" in line and "q_RS_w" in line for line in text.splitlines()):
            return Sniff(0.95, "EuRoC's header")
        if w_first and any(len(row.fields) >= COLUMNS and _is_nanoseconds(row.fields[0]) for row in _rows(text)[:2]):
            return Sniff(0.85, "nanoseconds and commas")
        return Sniff(0.0, "no stamps in nanoseconds with commas, then a quaternion with w first")

    def open(self, path: Path) -> Source:
        """The trajectory of the body that the file tells of (the IMU in EuRoC's own), ascending by stamp.

        Lines that are no pose are left out and noted. Raises `SourceError` where none is left.
        """
        path = file_of(Path(path))
        poses = {row.line: _pose(row) for row in _rows(read_text(path))}
        good = [pose for pose in poses.values() if pose is not None]
        bad = [line for line, pose in poses.items() if pose is None]
        if not good:
            raise SourceError(f"{path}: no line of `nanoseconds, x, y, z, qw, qx, qy, qz, …`: is it a EuRoC file?")
        table = np.array(good)
        refuse_other_columns(table, path)
        refuse_two_paths(table, path)
        parsed = ordered(table)
        notes = ["poses are those of the body in the file (EuRoC's ground truth: the IMU), not of a camera"]
        notes += parsed.notes
        if bad:
            notes.append(f"{counted(len(bad), 'line that is|lines that are')} no pose left out: {listed(bad)}")
        return Source(path.stem, path, trajectory=parsed.trajectory, notes=tuple(notes), files=(path,))


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class EurocWriter:
    """Writes a trajectory in EuRoC's form; a double holds seconds since 1970 to 0.2 microseconds, no better."""

    def write(self, path: Path, source: Source) -> tuple[str, ...]:
        """One file, atomically. Raises `SourceError` for stamps before zero, or two in one nanosecond."""
        trajectory = trajectory_of(source)
        stamps = [round(stamp * NANO) for stamp in trajectory.stamps_s.tolist()]
        if any(stamp < 0 for stamp in stamps) or len(set(stamps)) < len(stamps):
            raise SourceError(f"{source.path}: stamps before zero or closer than 1 ns: EuRoC counts nanoseconds")
        poses = trajectory.world_from_cam
        table = np.column_stack([poses[:, :3, 3], se3.to_quat_xyzw(poses)[:, [3, 0, 1, 2]]]) + 0.0
        lines = [f"{stamp},{','.join(map(repr, row))}\n" for stamp, row in zip(stamps, table.tolist(), strict=True)]
        write_text_atomically(Path(path), HEADER + "".join(lines))
        return written(counted(len(trajectory), "pose"), source, {"stamps"})


def file_of(path: Path) -> Path:
    """The file itself, or its usual place in EuRoC's folders."""
    places = ("data.csv", "state_groundtruth_estimate0/data.csv", "mav0/state_groundtruth_estimate0/data.csv")
    return next((path / place for place in places if (path / place).is_file()), path) if path.is_dir() else path


def _is_nanoseconds(word: str) -> bool:
    """Whether it can be nanoseconds since 1970: a whole number of so many digits is no count of frames."""
    return len(word) >= 16 and word.isdecimal()


def _rows(text: str) -> list[Row]:
    lines = enumerate(text.splitlines(), 1)
    rows = (Row(number, [field.strip() for field in line.split("#", 1)[0].split(",")]) for number, line in lines)
    return [row for row in rows if any(row.fields)]


def _pose(row: Row) -> list[float] | None:
    """The stamp in seconds, position and quaternion (x, y, z, w), or None where the line has none."""
    values = to_floats(row.fields[1:COLUMNS])
    stamp = row.fields[0]
    whole = stamp.isascii() and stamp.isdecimal() and len(stamp) < 20 and int(stamp) < MAX_STAMP_NS
    sound = values is not None and len(values) == COLUMNS - 1 and all(abs(v) < se3.MAX_NUMBER for v in values)
    if not whole or values is None or not sound or not 1e-6 < float(np.linalg.norm(values[3:])) < 1e6:
        return None
    return [float(stamp) / NANO, *values[:3], *values[4:], values[3]]
