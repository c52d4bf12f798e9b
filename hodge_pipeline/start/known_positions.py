"""Known positions (GNSS, surveyed) associated with the key frames."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path, PurePath

import numpy as np
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from hodge_pipeline import se3
from hodge_pipeline.errors import SourceError
from hodge_pipeline.scene import KeyFrames, Scene, has_real_stamps, sequences_of
from hodge_pipeline.solvers.positions import Fixes
from hodge_pipeline.sources.inspect import guess_reader
from hodge_pipeline.stages import Steps
from hodge_pipeline.types import Bools, Floats, Frame, Ints, Positions, Source, Trajectory, Words
from hodge_pipeline.types.notes import Note, notes_of
from hodge_pipeline.types.text import counted

OWN = "source"


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class PositionOptions:
    """Known positions of frames, such as satellite fixes: the result is then in their world, east, north, up."""

    path: Path | None = Field(
        default=None,
        description="a table whose first line names its columns: name or stamp; e,n,u or lat,lon,alt; sigma if known; "
        "or a recording with satellite fixes. source: those that come with the frames; none: no such world",
    )
    antenna_m: tuple[float, float, float] = Field(
        default=(0.0, 0.0, 0.0), description="metres: the point whose position is known, in the sensor's axes"
    )
    sigma_m: float = Field(
        default=2.0, gt=0, description="metres: sigma of positions that state none; it is adapted to how they scatter"
    )
    max_gap_s: float = Field(
        default=0.5, ge=0, description="seconds from a stamped position to the frames around it, by which it is placed"
    )


def known_positions(source: Source, options: PositionOptions, steps: Steps) -> Positions | None:
    """The positions that the options ask for, None for none. Raises `SourceError` where source or file hold none."""
    if options.path is None:
        return None
    if str(options.path) == OWN:
        if source.positions is None:
            raise SourceError(f"{source.path}: no satellite fixes come with its frames: give positions.path a table")
        return source.positions
    opened = guess_reader(options.path).open(options.path)
    steps.note(*notes_of("given file", (f"{options.path.name}: {note}" for note in opened.notes)))
    if opened.positions is None:
        raise SourceError(f"{options.path}: holds no known positions: positions.path wants a table of them")
    return opened.positions


def known_fixes(scene: Scene, options: PositionOptions, steps: Steps) -> Fixes | None:
    """The known positions as points of the scene's key frames; None, and `SourceError`, as of `known_positions`."""
    found = known_positions(scene.whole, options, steps)
    return None if found is None else fixes_of(found, options, scene, steps)


def fixes_of(positions: Positions, options: PositionOptions, scene: Scene, steps: Steps) -> Fixes:
    """Each position as a point of the key frame that its frame belongs to; at most one for each frame.

    Raises `SourceError` where none belongs to a frame.
    """
    keys, frames = scene.key_frames, scene.whole.frames
    named, stamped = positions.names != "", np.isfinite(positions.stamps_s)
    frame = np.full(len(positions), -1)
    poses = np.full((len(positions), 4, 4), np.nan)
    if named.any():
        frame[named] = _rows_by_name(positions.names[named], frames)
        poses[frame >= 0] = keys.first[frame[frame >= 0]]
    rest = np.flatnonzero((frame < 0) & stamped)
    if len(rest):
        frame[rest], poses[rest] = _at_stamps(positions.stamps_s[rest], scene.whole, keys, options.max_gap_s)
    found = _nearest_each(frame, positions.stamps_s, frames)
    if not len(found):
        raise SourceError(
            f"{options.path}: none of its {counted(len(positions), 'position')} is of a frame: "
            f"{_ranges(positions, frames)}"
        )
    if len(found) < len(positions):
        steps.note(Note("positions of no frame", len(positions) - len(found), str(len(positions))))
    key = keys.key_of_frame[frame[found]]
    key_from_frame = se3.inverse(keys.first[keys.rows[key]]) @ poses[found]
    covariances = positions.covariances[found]
    stated: Bools = np.asarray(np.isfinite(covariances).all(axis=(1, 2)))
    covariances = np.where(stated[:, None, None], covariances, options.sigma_m**2 * np.eye(3))
    arms = se3.transform(key_from_frame, np.broadcast_to(np.array(options.antenna_m), (len(found), 3))[:, None])[:, 0]
    labels = positions.labels[found]
    return Fixes(key, arms, positions.points[found], covariances, stated, labels, positions.origin)


def _rows_by_name(names: Words, frames: Sequence[Frame]) -> Ints:
    """The row of the frame that each name means, -1 for none: by its id, its file's name, or its number."""
    rows: dict[str, int] = {}
    spellings = (str, lambda name: PurePath(name).name, lambda name: PurePath(name).stem, _number)
    for spelling in reversed(spellings):  # the most exact one last: it wins
        rows |= {spelling(str(frame.frame_id)): row for row, frame in enumerate(frames)}
    found = (next((rows[key(name)] for key in spellings if key(name) in rows), -1) for name in names.tolist())
    return np.array(list(found), np.int64)


def _number(name: str) -> str:
    stem = PurePath(name).stem
    return str(int(stem)) if stem.isascii() and stem.isdecimal() else stem


def _at_stamps(stamps_s: Floats, source: Source, keys: KeyFrames, max_gap_s: float) -> tuple[Ints, Floats]:
    """The frame (P,) nearest to each stamp, -1 for none, and the pose (P, 4, 4) at the stamp, by the first poses."""
    frame, poses = np.full(len(stamps_s), -1), np.full((len(stamps_s), 4, 4), np.nan)
    gap_s = max_gap_s if has_real_stamps(source.frames) else 0.0
    for rows in sequences_of(source).values():
        rows = rows[keys.found[rows]]
        own = np.array([source.frames[row].stamp_s for row in rows])
        if not len(rows) or (np.diff(own) <= 0).any():
            continue
        at = se3.poses_at(Trajectory(own, keys.first[rows]), stamps_s, gap_s)
        known = se3.has_pose(at) & (frame < 0)
        poses[known] = at[known]
        frame[known] = rows[np.abs(own[:, None] - stamps_s[known]).argmin(axis=0)]
    return frame, poses


def _nearest_each(frame: Ints, stamps_s: Floats, frames: Sequence[Frame]) -> Ints:
    """Rows of the position nearest in time to each frame: more of one frame would not be independent."""
    rows = np.flatnonzero(frame >= 0)
    late = np.array([abs(stamps_s[row] - frames[frame[row]].stamp_s) for row in rows])
    order = rows[np.lexsort((np.nan_to_num(late), frame[rows]))]
    return np.sort(order[np.unique(frame[order], return_index=True)[1]])


def _ranges(positions: Positions, frames: Sequence[Frame]) -> str:
    if (positions.names != "").any():
        return f"it names {positions.names[0]}, …, the frames are {frames[0].frame_id}, …"
    stamps = [frame.stamp_s for frame in frames]
    return (
        f"its stamps are {np.nanmin(positions.stamps_s):.10g} to {np.nanmax(positions.stamps_s):.10g} s, the frames' "
        f"{min(stamps):.10g} to {max(stamps):.10g} s"
    )
