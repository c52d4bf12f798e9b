"""What a run works on: the key frames of a source, their clouds, the first poses, and how all frames follow from them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.se3 import spread_correction
from hodge_pipeline.types import Bools, CloudSet, Floats, Ints, Source
from hodge_pipeline.rounds import Round, sequences_of


@dataclass(frozen=True)
class KeyFrames:
    """Which of the N frames are registered, the K `rows`, and how the others move with them.

    `first (N, 4, 4)` are the first poses of all frames, `world_from_key (K, 4, 4)` those of the key frames; `part (N,)`
    is the part of the source that the start held together; `times (N,)` ascend within a part; `found (N,)` says which
    frames the start could place: the others lie between their neighbours by `stamps_s (N,)` in each `sequence (N,)`.
    """

    rows: Ints
    first: Floats
    world_from_key: Floats
    part: Ints
    times: Floats
    found: Bools
    stamps_s: Floats
    sequence: Ints

    @classmethod
    def all_of(cls, source: Source, world_from_cam: Floats) -> KeyFrames:
        """Every frame of the source is a key frame."""
        count = len(source.frames)
        stamps = np.array([frame.stamp_s for frame in source.frames], float)
        every, zeros = np.arange(count), np.zeros(count, np.int64)
        ones = np.ones(count, bool)
        return cls(every, world_from_cam, world_from_cam, zeros, every.astype(float), ones, stamps, zeros)

    @property
    def are_all(self) -> bool:
        """Whether every frame is a key frame."""
        return len(self.rows) == len(self.first)

    def expand(self, world_from_key: Floats) -> Floats:
        """Poses (N, 4, 4) of all frames that follow from those (K, 4, 4) of the key frames.

        Between two key frames the change that these went through is interpolated.
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
        for name in np.unique(self.sequence):
            rows = np.flatnonzero(self.sequence == name)
            after[rows] = _filled(after[rows], self.found[rows], self.stamps_s[rows])
        return np.asarray(after)


@dataclass(frozen=True)
class Drift:
    """What odometry says of the way between two frames: its poses (K, 4, 4), and the part (K,) that it held together."""

    world_from_cam: Floats
    part: Ints


@dataclass(frozen=True)
class Scene:
    """The whole source, its key frames as a source of their own, their clouds, and the first round: edges and poses.

    `drift`: None where the first poses are not odometry's.
    """

    whole: Source
    source: Source
    key_frames: KeyFrames
    clouds: CloudSet
    first: Round
    drift: Drift | None = None


def key_source(whole: Source, rows: Ints) -> Source:
    """The frames of these rows alone."""
    return replace(whole, frames=tuple(whole.frames[row] for row in rows))


def stamps_of(source: Source) -> Floats:
    """Times (N,) of the frames; their numbers in a sequence whose stamps do not ascend: those are no clock."""
    stamps = np.array([frame.stamp_s for frame in source.frames], float)
    for rows in sequences_of(source).values():
        if not (np.diff(stamps[rows]) > 0).all():
            stamps[rows] = np.arange(len(rows))
    return stamps


def sequence_numbers(source: Source) -> Ints:
    """The number (N,) of each frame's sequence, in the order of the source."""
    numbers = np.zeros(len(source.frames), np.int64)
    for number, rows in enumerate(sequences_of(source).values()):
        numbers[rows] = number
    return numbers


def _filled(poses: Floats, found: Bools, times: Floats) -> Floats:
    """The poses, those not found taken between the nearest found ones, or from the nearest at an end."""
    known = np.flatnonzero(found)
    if found.all() or not len(known):
        return poses
    missing = np.flatnonzero(~found)
    after = np.clip(np.searchsorted(known, missing), 0, len(known) - 1)
    before = np.clip(np.searchsorted(known, missing) - 1, 0, len(known) - 1)
    a, b = known[before], known[after]
    share = np.clip((times[missing] - times[a]) / np.where(b > a, times[b] - times[a], 1.0), 0.0, 1.0)
    out = poses.copy()
    out[missing] = se3.interpolate(poses[a], poses[b], share)
    return np.asarray(out)
