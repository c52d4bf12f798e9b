"""Redwood `.log` files: blocks of `i j n` and a 4x4 matrix. With i = j it is a pose, else it moves j into i."""

from __future__ import annotations

from dataclasses import dataclass as plain_dataclass
from dataclasses import field
from pathlib import Path

import numpy as np
from pydantic import ConfigDict
from pydantic.dataclasses import dataclass

from hodge_adapters.posed import written
from hodge_adapters.text_rows import Row, first_text, read_rows, rows_of, to_floats, write_text_atomically
from hodge_pipeline import se3
from hodge_pipeline.errors import SourceError
from hodge_pipeline.stages import Sniff
from hodge_pipeline.types import Floats, Ints, Source, Trajectory, ViewGraph
from hodge_pipeline.types.text import counted

MAX_NUMBER = 1 << 53
"""Beyond it doubles skip whole numbers."""


@plain_dataclass(frozen=True)
class LogFile:
    """`poses` world_from_cam by number; measured `pairs (E, 2)` of numbers with their `i_from_j (E, 4, 4)` and the
    third number of their heads, `counts (E,)`.
    """

    poses: dict[int, Floats] = field(default_factory=dict)
    pairs: Ints = field(default_factory=lambda: np.zeros((0, 2), np.int64))
    i_from_j: Floats = field(default_factory=lambda: np.zeros((0, 4, 4)))
    counts: Ints = field(default_factory=lambda: np.zeros(0, np.int64))


def read_log_file(path: Path) -> LogFile:
    """The poses and pairs of a file; rotations are made orthonormal (the files hold few digits).

    Raises `SourceError` with `file:line` for a block that is incomplete or no rigid motion, or a pose given twice.
    """
    numbers, body, lines = read_blocks(path, 4)
    good = se3.is_motion(body)
    if not good.all():
        line = lines[int(np.flatnonzero(~good)[0])]
        raise SourceError(f"{path}:{line}: not `i j n` and a rigid motion: mend or remove the block")
    body[:, :3, :3] = se3.project_to_so3(body[:, :3, :3])
    own = numbers[:, 0] == numbers[:, 1]
    if len(np.unique(numbers[own, 0])) < own.sum():
        raise SourceError(f"{path}: a pose is given twice: remove one of its blocks")
    poses = {int(number): pose for number, pose in zip(numbers[own, 0], body[own], strict=True)}
    return LogFile(poses, numbers[~own, :2], body[~own], numbers[~own, 2])


def begins_as_log(path: Path) -> bool:
    """Whether the first lines of a file are numbers, `i j n` and a row of four."""
    head, row = (*rows_of(first_text(path)), Row(0, []), Row(0, []))[:2]
    return to_floats(head.fields[:3] + row.fields) is not None and len(head.fields) > 1 and len(row.fields) == 4


def read_blocks(path: Path, size: int) -> tuple[Ints, Floats, list[int]]:
    """The heads `i j n` (N, 3), n 0 where a head has none, the matrices (N, size, size), and the line of each head.

    Raises `SourceError` with `file:line` for a block that is incomplete or no numbers.
    """
    rows, height = read_rows(path), size + 1
    if not rows or len(rows) % height:
        raise SourceError(
            f"{path}: {counted(len(rows), 'line is|lines are')} no blocks of `i j n` and a {size}x{size} "
            "matrix: is it whole?"
        )
    heads = rows[::height]
    wrong = [
        row.line for at, row in enumerate(rows) if len(row.fields) < 2 or (at % height and len(row.fields) != size)
    ]
    try:
        keys = np.array([[*row.fields[:3], "0"][:3] for row in heads], np.float64)
        body = np.array([row.fields for at, row in enumerate(rows) if at % height], np.float64)
    except ValueError:
        wrong = wrong or [heads[0].line]
    if wrong:
        raise SourceError(f"{path}:{wrong[0]}: not `i j n` and {size} rows of {size} numbers: mend the file")
    sound = ((np.floor(keys) == keys) & (keys >= 0) & (keys < MAX_NUMBER)).all(axis=1)
    if not sound.all():
        line = heads[int(np.argmin(sound))].line
        raise SourceError(f"{path}:{line}: not `i j n` and a {size}x{size} matrix: mend or remove the block")
    return keys.astype(np.int64), body.reshape(-1, size, size), [row.line for row in heads]


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class LogReader:
    """Opens a Redwood `.log` file: a trajectory, or a graph of measured pairs."""

    def sniff(self, path: Path) -> Sniff:
        """By the ending."""
        is_log = Path(path).suffix == ".log" and Path(path).is_file()
        return Sniff(0.8, "a .log file") if is_log else Sniff(0.0, "not a .log file")

    def open(self, path: Path) -> Source:
        """Poses as a trajectory whose stamps are the numbers; pairs as a graph."""
        path = Path(path)
        found = read_log_file(path)
        trajectory = graph = None
        if found.poses:
            numbers = sorted(found.poses)
            trajectory = Trajectory(np.array(numbers, float), np.array([found.poses[n] for n in numbers]))
        if len(found.pairs):
            ids, rows = np.unique(found.pairs, return_inverse=True)
            graph = ViewGraph.from_edges(ids, rows.reshape(-1, 2), found.i_from_j, source="log")
        return Source(path.stem, path, trajectory=trajectory, graph=graph, files=(path,), of_cameras=True)


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class LogWriter:
    """Writes a Redwood `.log`: the trajectory where there is one, else the graph's edges."""

    def write(self, path: Path, source: Source) -> tuple[str, ...]:
        """One file, atomically. Whole stamps are the numbers of the poses, else the rows; edges need integer ids."""
        if source.trajectory is not None:
            stamps = source.trajectory.stamps_s
            whole = np.equal(np.mod(stamps, 1), 0).all() and (stamps >= 0).all()
            numbers = stamps.astype(np.int64) if whole else np.arange(len(stamps))
            write_text_atomically(path, _blocks(np.column_stack([numbers, numbers]), source.trajectory.world_from_cam))
            return written(counted(len(stamps), "pose"), source, {"stamps"} if whole else ())
        if source.graph is not None and source.graph.vertex_ids.dtype.kind in "iu":
            pairs = source.graph.vertex_ids[source.graph.edges].astype(np.int64)
            write_text_atomically(path, _blocks(pairs, source.graph.i_from_j, source.graph.vertex_count))
            return written(counted(len(pairs), "edge"), source, {"edges"})
        raise SourceError(f"{source.path}: no trajectory, and no graph with numbered vertices, to write as .log")


def _blocks(keys: Ints, motions: Floats, count: int | None = None) -> str:
    text = []
    for (i, j), motion in zip(keys.tolist(), (motions + 0.0).tolist(), strict=True):
        text.append(f"{i} {j} {i + 1 if count is None else count}\n")
        text += [" ".join(map(repr, row)) + "\n" for row in motion]
    return "".join(text)
