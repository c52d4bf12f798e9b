"""What a run works on and what it finds: key frames, their clouds, how all frames follow from them, and its rounds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hodge_pipeline import se3
from hodge_pipeline.complex.energies import Energies
from hodge_pipeline.errors import SourceError
from hodge_pipeline.se3 import spread_correction
from hodge_pipeline.types import Bools, CloudSet, Edges, Floats, Frame, Ints, Solution, Source, Trajectory, ViewGraph
from hodge_pipeline.types.edges import REJECTED
from hodge_pipeline.types.positions import PositionFit

START = "start"
"""The name of given poses, and of first poses that are not odometry's."""
FIRST = "first poses"
"""Their name where they are not the given ones."""
SHORTEST_STEP_S = 1e-3
"""Depth cameras take 300 frames a second at most (RealSense D435)."""
UNIX_STAMP_S = 1e8
"""Stamps above this (1973) are seconds since 1970, smaller ones count from a start of their own."""

STEPS_OF_VELOCITY, CARRIED_STEPS = 3, 10
"""Steps whose mean velocity carries on poses at an end that was not found, and the most that it does: at ten steps the
true positions of walks, drives and hand-held cameras are 2 to 19 times as near to it as to the last pose found, their
turns as near; farther on turns are farther off."""


@dataclass(frozen=True)
class Round:
    """One outer iteration: every pair that it knows of, and the poses (N, 4, 4) that its edges led to. Round 0 holds
    the first poses, which `name` tells: odometry, or start where they were given.

    The pairs that any round so far registered come first in `edges`, then those that came measured. This round itself
    registered the rows `fresh (F,)` from the poses `before (N, 4, 4)`; `energies` are those of ω's parts at the poses
    that the solve started from. It is `edited` where a person's edits made it. `position_fit`: how known positions fit
    it, None without any.
    """

    edges: Edges
    vertex_ids: NDArray[np.generic]
    world_from_cam: Floats
    solution: Solution | None = None
    fresh: Ints | None = None
    before: Floats | None = None
    energies: Energies | None = None
    edited: bool = False
    name: str = "odometry"
    position_fit: PositionFit | None = None

    @property
    def graph_edges(self) -> Edges:
        """The rows that are edges, in the order of `graph`: those that count, and those that are off by hand."""
        return self.edges.select(self.edges.in_graph)

    @cached_property
    def graph(self) -> ViewGraph:
        """The viewing graph."""
        return self.edges.as_graph(self.vertex_ids, self.edges.in_graph)

    @property
    def rejected(self) -> Edges:
        """The pairs that were registered and are no edges."""
        return self.edges.select(self.edges.status == REJECTED)

    def registered(self, measured: ViewGraph) -> Edges:
        """The rows without those that came measured."""
        return self.edges.select(slice(len(self.edges) - measured.edge_count))


@dataclass(frozen=True)
class KeyFrames:
    """Which of the N frames are registered, the K `rows`, and how the others move with them.

    `first (N, 4, 4)` are the first poses of all frames, `world_from_key (K, 4, 4)` those of the key frames; `part (N,)`
    is the part of the source that the start held together; `times (N,)` ascend within a part; `found (N,)` says which
    frames the start could place: the others lie between their neighbours by `stamps_s (N,)` in each `sequence (N,)`,
    or are carried on at its ends.
    `key_of_frame (N,)` is the key frame, counted among the K, that each frame belongs to; the rows `apart (A,)` are of
    frames with black images that move with it alone, since clouds placed them, but flow the next key frame; `readout_s`
    is the estimated read-out time, None where cameras keep their own.
    """

    rows: Ints
    first: Floats
    world_from_key: Floats
    part: Ints
    times: Floats
    found: Bools
    stamps_s: Floats
    sequence: Ints
    key_of_frame: Ints
    readout_s: float | None = None
    apart: Ints = field(default_factory=lambda: np.zeros(0, np.int64))

    @classmethod
    def all_of(cls, source: Source, world_from_cam: Floats) -> KeyFrames:
        """Every frame of the source is a key frame."""
        count = len(source.frames)
        stamps = np.array([frame.stamp_s for frame in source.frames], float)
        every, zeros = np.arange(count), np.zeros(count, np.int64)
        ones = np.ones(count, bool)
        return cls(every, world_from_cam, world_from_cam, zeros, every.astype(float), ones, stamps, zeros, every)

    @property
    def are_all(self) -> bool:
        """Whether every frame is a key frame."""
        return len(self.rows) == len(self.first)

    def expand(self, world_from_key: Floats) -> Floats:
        """Poses (N, 4, 4) of all frames that follow from those (K, 4, 4) of the key frames.

        Between two key frames the change that these went through is interpolated, but for what is `apart`.
        """
        if self.are_all:
            return world_from_key
        after = self.first.copy()
        for part in np.unique(self.part):
            rows = np.flatnonzero(self.part == part)
            keys = np.flatnonzero(self.part[self.rows] == part)
            after[rows] = spread_correction(
                self.times[rows], self.first[rows], self.times[self.rows[keys]], self.world_from_key[keys],
                world_from_key[keys],
            )  # fmt: skip
        own = self.key_of_frame[self.apart]
        after[self.apart] = world_from_key[own] @ se3.inverse(self.world_from_key[own]) @ self.first[self.apart]
        for name in np.unique(self.sequence):
            rows = np.flatnonzero(self.sequence == name)
            after[rows] = _filled(after[rows], self.found[rows], self.stamps_s[rows], self.part[rows])
        return np.asarray(after)

    def of_frames(self, of_key: Ints) -> Ints:
        """What holds for each key frame (K,), as its component, for each of the frames (N,) that follow it; one that
        was not found follows what the frames follow between which it is posed.
        """
        out = of_key[self.key_of_frame]
        for name in np.unique(self.sequence):
            rows = np.flatnonzero(self.sequence == name)
            out[rows] = out[rows[_nearest_found(self.found[rows])[0]]]
        return out


def choose_key_frames(
    world_from_cam: Floats, sequences: Sequence[Ints], distance_m: float, angle_deg: float, every: int
) -> Ints:
    """Rows of the key frames, ascending: first and last of each sequence, every n-th, and wherever it moved."""
    chosen: list[int] = []
    for rows in sequences:
        last = int(rows[0])
        chosen.append(last)
        for place, row in enumerate(map(int, rows[1:]), start=1):
            step = se3.inverse(world_from_cam[last]) @ world_from_cam[row]
            turned_deg = np.rad2deg(se3.rotation_angle(step))
            moved = np.linalg.norm(step[:3, 3]) >= distance_m or turned_deg >= angle_deg
            if moved or (every and place % every == 0):
                chosen.append(row)
                last = row
        if chosen[-1] != int(rows[-1]):
            chosen.append(int(rows[-1]))
    return np.array(sorted(chosen), np.int64)


@dataclass(frozen=True)
class Drift:
    """What odometry says of the path between two frames: its poses (K, 4, 4), the part (K,) of each that it held
    together, the `covariance (K, 6, 6)` of the path from the first row to each, in the world's axes, and the squared
    Mahalanobis distance from which on a pair contradicts it.
    """

    world_from_cam: Floats
    part: Ints
    covariance: Floats
    gate: float


@dataclass(frozen=True)
class Closed:
    """The first poses (K, 4, 4), the loops along the path closed, and the pairs (P, 2) that closed them."""

    world_from_cam: Floats
    pairs: Ints


@dataclass(frozen=True)
class GivenFile:
    """A file of given poses, what it holds, and the moments (P,) of its poses on the clock of `KeyFrames.times`.

    `true_world_from_cam (P, 4, 4)` is the truth nearest to each pose, NaN where there is none; `has_frame (P,)`: which
    poses lie among the frames.
    """

    path: Path
    trajectory: Trajectory
    pose_times: Floats
    true_world_from_cam: Floats
    has_frame: Bools

    def expand(self, key_frames: KeyFrames, world_from_key: Floats) -> Floats:
        """The poses (P, 4, 4) of the file, corrected as the key frames (K, 4, 4) were."""
        times, poses = key_frames.times[key_frames.rows], self.trajectory.world_from_cam
        return spread_correction(self.pose_times, poses, times, key_frames.world_from_key, world_from_key)


@dataclass(frozen=True)
class Scene:
    """The whole source, its key frames as a source of their own, their clouds, and the first round: edges and poses.

    `drift`: None where the first poses are not odometry's; `given`: the file that they come from, where there is one;
    `in_order`: whether frames that follow each other in the source do so in time; `sightings`: the folder of what
    frames that are no key frames saw of these, where they were tracked; `closed`: the first poses with
    the loops along the path closed, None where nobody looked for any; `steps_stand`: whether the first steps are more
    exact than a registration of their two clouds.
    """

    whole: Source
    source: Source
    key_frames: KeyFrames
    clouds: CloudSet
    first: Round
    drift: Drift | None = None
    is_given: bool = False
    given: GivenFile | None = None
    in_order: bool = True
    sightings: Path | None = None
    closed: Closed | None = None
    steps_stand: bool = False


def key_source(whole: Source, rows: Ints) -> Source:
    """The frames of these rows alone."""
    return replace(whole, frames=tuple(whole.frames[row] for row in rows))


def vertex_ids(source: Source) -> NDArray[np.generic]:
    """The frames as the source names them: numbers, or words."""
    return np.array([frame.frame_id for frame in source.frames])


def stamps_of(source: Source) -> Floats:
    """Times (N,) of the frames, ascending in each sequence: where its clock goes back, by a step as long as the others.

    In a sequence whose stamps are no clock's, or no camera's, or mostly do not ascend, the times are the numbers of the
    frames.
    """
    stamps = np.array([frame.stamp_s for frame in source.frames], float)
    for rows in sequences_of(source).values():
        steps_s = np.diff(stamps[rows])
        ahead = steps_s > 0
        is_sound = not faster_than_cameras(stamps[rows])
        if ahead.all() and is_sound:
            continue
        if is_clock(stamps[rows]) and 2 * ahead.sum() > len(steps_s) and is_sound:
            steps_s = np.where(ahead, steps_s, np.median(steps_s[ahead]))
            stamps[rows[1:]] = stamps[rows[0]] + np.cumsum(steps_s)
        else:
            stamps[rows] = np.arange(len(rows))
    return stamps


def faster_than_cameras(stamps_s: Floats) -> bool:
    """Whether stamps (N,) of a clock follow each other faster than any camera's images: made up, or of another unit."""
    steps_s = np.diff(stamps_s)
    ahead = steps_s[steps_s > 0]
    return is_clock(stamps_s) and len(ahead) > 0 and float(np.median(ahead)) < SHORTEST_STEP_S


def has_real_stamps(frames: Sequence[Frame]) -> bool:
    """Whether the stamps are a clock's: finite, not all one value, and not merely numbers of frames or of rows."""
    return is_clock(np.array([frame.stamp_s for frame in frames]))


def is_clock(stamps: Floats) -> bool:
    """Whether stamps (N,) are seconds of a clock, as `has_real_stamps` has it."""
    if not len(stamps) or not np.isfinite(stamps).all() or not np.ptp(stamps) > 0:
        return False
    return bool(stamps.min() > UNIX_STAMP_S or (np.mod(stamps, 1) != 0).any())


def sequence_numbers(source: Source) -> Ints:
    """The number (N,) of each frame's sequence, in the order of the source."""
    numbers = np.zeros(len(source.frames), np.int64)
    for number, rows in enumerate(sequences_of(source).values()):
        numbers[rows] = number
    return numbers


def own_trajectory(source: Source) -> Trajectory | None:
    """The trajectory of a source, or the poses of its frames as one; None where it has neither.

    Raises `SourceError` where frames of several sequences have stamps that repeat.
    """
    if source.trajectory is not None:
        return source.trajectory
    found = Trajectory.of_frames(source.frames)
    if found is not None and (np.diff(found.stamps_s) <= 0).any():
        raise SourceError(f"{source.path}: several sequences with stamps of their own: give one sequence's folder")
    return found


def _filled(poses: Floats, found: Bools, times: Floats, part: Ints) -> Floats:
    """The poses, those not found taken between the nearest found ones, or carried on from those at an end."""
    missing = np.flatnonzero(~found)
    if not len(missing) or not found.any():
        return poses
    a, b = _nearest_found(found)[:, missing]
    share = np.clip((times[missing] - times[a]) / np.where(b > a, times[b] - times[a], 1.0), 0.0, 1.0)
    out = poses.copy()
    out[missing] = se3.interpolate(poses[a], poses[b], share)
    known = np.flatnonzero(found)
    longest_s = CARRIED_STEPS * float(np.median(np.abs(np.diff(times))))
    for ends, rows in ((known, missing[missing < known[0]]), (known[::-1], missing[missing > known[-1]])):
        near = [row for row in ends[: STEPS_OF_VELOCITY + 1] if part[row] == part[ends[0]]]
        first, last = near[0], near[-1]
        if len(rows) and times[first] != times[last]:
            rate = se3.log(se3.inverse(poses[first]) @ poses[last]) / (times[last] - times[first])
            away_s = np.clip(times[rows] - times[first], -longest_s, longest_s)
            out[rows] = poses[first] @ se3.exp(away_s[:, None] * rate)
    return np.asarray(out)


def _nearest_found(found: Bools) -> Ints:
    """The last found place up to each and the first from it on (2, N); the nearest twice at an end."""
    every, known = np.arange(len(found)), np.flatnonzero(found)
    if not len(known):
        return np.stack([every, every])
    before = known[np.maximum(np.searchsorted(known, every, side="right") - 1, 0)]
    return np.stack([before, known[np.minimum(np.searchsorted(known, every), len(known) - 1)]])


def pose_sets(rounds: Sequence[Round], source: Source) -> dict[str, Floats]:
    """The poses by name: start, odometry, round 1, …, result.

    `start` are poses that the run started from, or that the source gives and that are not called true.
    """
    first = rounds[0].name
    sets: dict[str, Floats] = {}
    if has_given(source):
        sets[START], first = given_poses(source), FIRST if first == START else first
    names = [first, *(f"round {number}" for number in range(1, len(rounds) - 1)), "result"]
    return sets | {name: one.world_from_cam for name, one in zip(names, rounds, strict=True)}


def given_poses(source: Source) -> Floats:
    """The poses (N, 4, 4) that the source gives, NaN where a frame has none."""
    return _matrices([frame.world_from_cam for frame in source.frames])


def true_poses(source: Source) -> Floats:
    """The true poses (N, 4, 4), NaN where a frame has none."""
    return _matrices([frame.true_world_from_cam for frame in source.frames])


def _matrices(poses: Sequence[Floats | None]) -> Floats:
    return np.array([np.full((4, 4), np.nan) if pose is None else pose for pose in poses]).reshape(-1, 4, 4)


def has_given(source: Source) -> bool:
    """Whether the source gives poses to at least half of its frames, and these are not the true ones."""
    given, true = given_poses(source), true_poses(source)
    known = se3.has_pose(given) & (given != true).any(axis=(1, 2))
    return bool(known.sum() > 1 and 2 * known.sum() >= len(known))


def has_truth(source: Source) -> bool:
    """Whether there are at least two true poses to compare with."""
    return sum(frame.true_world_from_cam is not None for frame in source.frames) > 1


def sequences_of(source: Source) -> dict[str, Ints]:
    """The rows of each sequence, in the order of the source."""
    names = np.array([frame.sequence for frame in source.frames])
    return {str(name): np.flatnonzero(names == name) for name in dict.fromkeys(names.tolist())}
