"""Initial poses from another program: associated with the frames; odometry fills the gaps between sparse ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from pydantic import Field
from pydantic.dataclasses import dataclass

from hodge_pipeline import se3
from hodge_pipeline.errors import SourceError
from hodge_pipeline.evaluation.trajectory import associate
from hodge_pipeline.registration.clouds import CloudOptions
from hodge_pipeline.registration.odometry import OdometryOptions
from hodge_pipeline.registration.tracking.shutter import velocities
from hodge_pipeline.scene import (
    START,
    GivenFile,
    KeyFrames,
    Round,
    Scene,
    choose_key_frames,
    has_truth,
    key_source,
    own_trajectory,
    sequence_numbers,
    sequences_of,
    stamps_of,
    true_poses,
    vertex_ids,
)
from hodge_pipeline.se3 import spread_correction
from hodge_pipeline.sources.inspect import guess_reader
from hodge_pipeline.stages import OPTIONS, Steps, Workers
from hodge_pipeline.start.at_stamps import with_landmarks_at_stamps
from hodge_pipeline.start.clouds import make_clouds
from hodge_pipeline.start.match_poses import Match, Matched, match_poses, own_poses
from hodge_pipeline.start.odometry import chain
from hodge_pipeline.start.sweep_times import deskewed_along
from hodge_pipeline.types import Bools, CloudSet, Edges, Floats, Ints, Source, Trajectory
from hodge_pipeline.types.notes import Note, notes_of
from hodge_pipeline.types.text import counted

JUMP_SHARE = 0.25
"""Share of the motion between key frames above which an odd step is a jump: smaller ones matter little."""
NO_VELOCITY_SHARE = 1.0
"""The same for steps that tell no velocity: of 59 true ones of fr1/rpy at 10 Hz 14 differ by a quarter, none by all."""
SAME_M = 1e-6
"""Metres and rotation entries within which given poses count as the true ones."""


@dataclass(frozen=True, config=OPTIONS)
class GivenStart:
    """Starts from the poses of another program, and registers key frames among the frames."""

    path: Path | None = Field(
        default=None, description="a trajectory of any format that a reader opens; null: the poses of the frames"
    )
    match: Match = Field(
        default="auto",
        description="how a frame finds its pose in the file: stamp, between two poses; number, that of the frame; row, "
        "the n-th pose is that of the n-th frame; auto: the first of these that fits",
    )
    max_gap_s: float = Field(
        default=0.1,
        ge=0,
        description="seconds to the poses around a frame's stamp; frames with a wider gap, between the sparse poses of "
        "key frames, are carried over it by odometry",
    )
    odometry: OdometryOptions = Field(default=OdometryOptions(), description="between sparse poses")
    distance_m: float = Field(
        default=0.1, ge=0, description="metres from the last key frame at which a frame becomes one; 0: every frame"
    )
    angle_deg: float = Field(default=8.0, ge=0, description="degrees, likewise")
    every: int = Field(
        default=5,
        ge=0,
        description="frames: every such frame of a sequence is a key frame, however little it moved, since given poses "
        "can jump where their maker joined two pieces; 0: none for that reason",
    )

    def begin(self, source: Source, clouds: CloudOptions, steps: Steps, workers: Workers) -> Scene:
        """The key frames at their given poses, without an edge yet.

        Raises `SourceError` where there are none, or those of the file are not of these frames.
        """
        matched, file = self._matched(source, steps)
        known = se3.has_pose(matched.world_from_cam)
        told = (
            f"{counted(len(source.frames), 'frame has|frames have')} a given pose, by {matched.how}; "
            f"{len(matched.pose_times)}"
        )
        steps.note(Note("given poses", int(known.sum()), told))
        poses = matched.world_from_cam
        if not known.all():
            poses = self._bridged(source, matched, clouds, steps, workers)
        sequences = list(sequences_of(source).values())
        rows = choose_key_frames(poses, sequences, self.distance_m, self.angle_deg, self.every)
        rows = np.union1d(rows, self._jumps(poses, sequences, JUMP_SHARE))
        steps.note(Note("key frames", len(rows), str(len(source.frames))))
        whole = deskewed_along(without_given_poses(source, poses, rows), poses, clouds, steps)
        keys = replace(key_source(whole, rows), graph=None)
        steps.remember(keys, steps.key([source, rows, poses]) + "deskewed")
        steps.remember(whole, steps.key([source, poses]) + "deskewed")
        made = make_clouds(keys, clouds, steps, workers)
        jumped = self._jumps(poses, sequences, NO_VELOCITY_SHARE)[:, 1]
        made = _at_stamps(source, keys, rows, poses, jumped, made, clouds.unit_m, steps)
        first = Round(Edges.of([]), vertex_ids(keys), poses[rows], name=START)
        key_frames = _key_frames(source, rows, poses, matched.frame_times)
        return Scene(whole, keys, key_frames, made, first, is_given=True, given=file)

    def _jumps(self, poses: Floats, sequences: Sequence[Ints], share: float) -> Ints:
        """The rows (J, 2) at both ends of each step that differs from the steps before and after it, of the first and
        last from the one beside it, by this share of the motion between key frames: its correction is not spread over
        the frames around it, nor is its velocity theirs.
        """
        most_m, most_deg = (share * (far or np.inf) for far in (self.distance_m, self.angle_deg))
        found = [np.zeros((0, 2), np.int64)]
        for rows in sequences:
            if len(rows) < 3:
                continue
            steps = se3.inverse(poses[rows[:-1]]) @ poses[rows[1:]]
            change = se3.inverse(steps[:-1]) @ steps[1:]
            turned_deg = np.rad2deg(se3.rotation_angle(change))
            unlike = (np.linalg.norm(change[:, :3, 3], axis=1) >= most_m) | (turned_deg >= most_deg)
            is_jump = np.r_[unlike[0], unlike] & np.r_[unlike, unlike[-1]]
            found.append(np.stack([rows[:-1], rows[1:]], axis=1)[is_jump])
        return np.concatenate(found)

    def _matched(self, source: Source, steps: Steps) -> tuple[Matched, GivenFile | None]:
        if self.path is None:
            matched = own_poses(source)
            if not len(matched.pose_times):
                raise SourceError(f"{source.path}: its frames have no poses: give a file of them (start.path)")
            return matched, None
        trajectory = read_trajectory(self.path, steps)
        matched = match_poses(trajectory, source.frames, self.match, self.max_gap_s, str(self.path))
        true = _true_at(matched.pose_times, matched, source)
        if has_truth(source) and not np.isfinite(true).any():
            steps.note(Note("no truth near", detail=str(self.path)))
        outside = matched.outside()
        if 2 * outside > len(source.frames):
            steps.note(Note("frames outside", outside, str(len(source.frames))))
        has_frame = matched.has_frame(self.max_gap_s)
        return matched, GivenFile(self.path, trajectory, matched.pose_times, true, has_frame)

    def _bridged(
        self, source: Source, matched: Matched, clouds: CloudOptions, steps: Steps, workers: Workers
    ) -> Floats:
        """A pose for every frame: odometry over the gaps, its error against the given poses spread along each gap.

        A sequence without any given pose begins at the nearest given pose of another.
        """
        given = matched.world_from_cam
        known: Bools = se3.has_pose(given)
        steps.note(Note("carried", int((~known).sum())))
        gaps = gaps_between(known, list(sequences_of(source).values()))
        rows = np.concatenate(gaps)
        part = key_source(source, rows)
        steps.remember(part, steps.key([source, rows]))
        made = make_clouds(part, clouds, steps, workers)
        stamps = np.array([frame.stamp_s for frame in part.frames])
        ends = np.cumsum([0, *map(len, gaps)])
        places = tuple(np.arange(start, end) for start, end in pairwise(ends))
        title = "poses between the given ones"
        found = steps.step(
            chain, made, places, stamps, clouds.unit_m, self.odometry,
            title=title, total=len(rows), workers=workers,
        )  # fmt: skip
        poses = given.copy()
        for gap, place in zip(gaps, places, strict=True):
            poses[gap[~known[gap]]] = _carried(found.world_from_cam[place], gap, given, known)
        return np.asarray(poses)


def _at_stamps(
    source: Source,
    keys: Source,
    rows: Ints,
    poses: Floats,
    jumped: Ints,
    made: CloudSet,
    unit_m: float,
    steps: Steps,
) -> CloudSet:
    """The clouds of the key frames `rows (K,)`, landmarks moved by the velocities that given poses (N, 4, 4) have
    between jumps, the steps to the rows `jumped (J,)`: poses of another unit jump at every step.

    Those of a rough path serve: of fr1/rpy, which turns 60 degrees a second, poses that err by 10 mm and 0.5 degrees
    each tell its velocity to 6.
    """
    sequence = sequence_numbers(source)
    is_jump = np.isin(np.arange(len(poses)), jumped)
    smooth = len(poses) * sequence + np.cumsum(is_jump)
    twists = velocities(poses, stamps_of(source), smooth, np.ones(len(poses), bool))
    first = np.flatnonzero(sequence[rows[1:]] == sequence[rows[:-1]])
    pairs = np.stack([first, first + 1], axis=1)
    return with_landmarks_at_stamps(keys, made, poses[rows], twists[rows], pairs, unit_m, steps)


def _key_frames(source: Source, rows: Ints, poses: Floats, times: Floats) -> KeyFrames:
    """`KeyFrames` by `rows (K,)`, poses (N, 4, 4) and times (N,); every frame follows the last key frame before it."""
    count = len(poses)
    return KeyFrames(
        rows=rows,
        first=poses,
        world_from_key=poses[rows],
        part=np.zeros(count, np.int64),
        times=times,
        found=np.ones(count, bool),
        stamps_s=times,
        sequence=sequence_numbers(source),
        key_of_frame=np.clip(np.searchsorted(rows, np.arange(count), side="right") - 1, 0, None),
    )


def gaps_between(known: Bools, sequences: Sequence[Ints]) -> list[Ints]:
    """Runs of rows that hold every frame without a pose, with one posed frame after it and two before, from which
    odometry takes its first velocity.
    """
    runs = []
    for rows in sequences:
        missing = ~known[rows]
        near = missing.copy()
        near[1:] |= missing[:-1]
        near[:-1] |= missing[1:]
        near[:-2] |= missing[2:]
        cuts = np.split(np.arange(len(rows)), np.flatnonzero(np.diff(near)) + 1)
        runs += [rows[cut] for cut in cuts if near[cut[0]]]
    return runs


def _carried(odometry: Floats, gap: Ints, given: Floats, known: Bools) -> Floats:
    """Poses (M, 4, 4) of the frames of a gap that have none, by odometry (R, 4, 4) over it."""
    inside = known[gap]
    times = gap.astype(float)
    if inside.any():
        found = spread_correction(times, odometry, times[inside], odometry[inside], given[gap[inside]])
        return found[~inside]
    rows = np.flatnonzero(known)
    nearest = rows[np.argmin(np.abs(rows - gap[0]))]
    return np.asarray(given[nearest] @ se3.inverse(odometry[0]) @ odometry)


def without_given_poses(source: Source, poses: Floats, rows: np.ndarray) -> Source:
    """The source without its frames' own poses, since the run starts from given ones, and without true poses where
    those are the given ones: there is nothing to compare with then.
    """
    given = [(source.frames[row].true_world_from_cam, poses[row]) for row in rows]
    same = [true is not None and np.abs(true - pose).max() < SAME_M for true, pose in given]
    is_truth = sum(same) > len(same) / 2
    frames = tuple(
        replace(frame, world_from_cam=None, true_world_from_cam=None if is_truth else frame.true_world_from_cam)
        for frame in source.frames
    )
    return replace(source, frames=frames)


def _true_at(times: Floats, matched: Matched, source: Source) -> Floats:
    """The true pose (P, 4, 4) nearest in time to each given one, NaN where there is none near."""
    true = true_poses(source)
    known = se3.has_pose(true)
    true_times, true = matched.frame_times[known], true[known]
    if matched.how == "stamp" and known.any() and source.trajectory is not None:
        true_times, true = source.trajectory.stamps_s, source.trajectory.world_from_cam
    rows, true_rows = associate(times, true_times)
    found = np.full((len(times), 4, 4), np.nan)
    found[rows] = true[true_rows]
    return found


def read_trajectory(path: Path, steps: Steps) -> Trajectory:
    """The poses in a file of any format that a reader opens; the reader's notes are passed on. Raises `SourceError`."""
    opened = guess_reader(path).open(path)
    if opened.graph is not None and opened.graph.edge_count:
        raise SourceError(f"{path}: a graph of measured edges, which needs no frames: give it to hodge solve")
    steps.note(*notes_of("given file", (f"{path.name}: {note}" for note in opened.notes)))
    found = own_trajectory(replace(opened, path=path))
    if found is None:
        raise SourceError(f"{path}: has no poses to start from: give a trajectory; a graph goes to hodge solve")
    return found
