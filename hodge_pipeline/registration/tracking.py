"""Long sequences: each frame is registered to the last key frame, and key frames alone are kept.

A frame becomes a key frame where the camera has moved far enough from the last one, or sees too little of what that
saw. The sequence is cut into blocks that are tracked side by side, so nothing depends on how many workers there are,
and memory holds one block a worker, never the sequence.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.registration.clouds import CloudOptions, cloud_or_note, with_landmarks
from hodge_pipeline.registration.odometry import OdometryOptions
from hodge_pipeline.types import Edges, Floats, Frame, Ints, PointCloud, Registration

FRAMES_IN_BLOCK = 48
"""About three seconds of work; the first and the last frame of a block are key frames, however little they moved."""
LONGEST_GUESS = 4.0
"""Frame steps over which a motion is taken to go on as it was."""


@dataclass(frozen=True)
class TrackingOptions:
    """How frames are followed: `clouds` of key frames, `followed` of all others; a frame that has moved `distance_m` or
    `angle_rad` from the last key frame, or shares less than `kept_fitness` with it, becomes one.
    """

    clouds: CloudOptions
    followed: CloudOptions
    odometry: OdometryOptions
    distance_m: float
    angle_rad: float
    kept_fitness: float = 0.5


@dataclass(frozen=True)
class FrameBlock:
    """Consecutive rows (M,) of one sequence, their frames and times; the first is there for its velocity alone where
    `warm_up`.
    """

    rows: Ints
    frames: tuple[Frame, ...]
    times: Floats
    warm_up: bool


@dataclass(frozen=True)
class TrackedBlock:
    """What became of a block: its key frames (rows, clouds), the steps from each to the next, and for every row the row
    of the key frame that it was registered to, the motion, and its fitness: NaN where the motion is a guess.

    A step of fitness 0 is a guess too. The block's last row is the first of the next one.
    """

    keys: Ints
    clouds: tuple[PointCloud, ...]
    steps: Edges
    rows: Ints
    anchors: Ints
    key_from_row: Floats
    fitness: Floats
    notes: tuple[str, ...]


def frame_blocks(rows: Ints, frames: tuple[Frame, ...], times: Floats) -> list[FrameBlock]:
    """The blocks of one sequence: `frames (N,)` and `times (N,)` are the whole source's, `rows` the sequence's."""
    blocks = []
    for start in range(0, max(1, len(rows) - 1), FRAMES_IN_BLOCK):
        first = max(0, start - 1)
        part = rows[first : start + FRAMES_IN_BLOCK + 1]
        blocks.append(FrameBlock(part, tuple(frames[row] for row in part), times[part], start > 0))
    return blocks


def track_block(options: TrackingOptions, block: FrameBlock) -> TrackedBlock:
    """The block, tracked."""
    return _Tracker(options, block).run()


@dataclass(frozen=True)
class _View:
    """A frame as the registrar wants it: its place in the block, its cloud, and what was prepared of it."""

    place: int
    cloud: PointCloud
    prepared: Any


class _Tracker:
    """Follows one block: the last key frame, the last frame tracked, and the frame after it where that was lost.

    `_rows` holds for each place its key frame's place, the motion to it, and the fitness, NaN for a guess.
    """

    def __init__(self, options: TrackingOptions, block: FrameBlock) -> None:
        self._options, self._block = options, block
        self._registrar, self._limits = options.odometry.registration, options.odometry
        self._notes: dict[int, str] = {}
        self._rows: dict[int, tuple[int, Floats, float]] = {}
        self._keys: list[_View] = []
        self._steps: list[tuple[int, int, Registration]] = []
        self._velocity: Floats = np.zeros(6)
        self._usual_step = float(np.median(np.diff(block.times))) if len(block.times) > 1 else 1.0

    def run(self) -> TrackedBlock:
        first, count = int(self._block.warm_up), len(self._block.rows)
        start = self._view(first)
        if self._block.warm_up:
            self._warm_up(start)
        self._begin(start)
        for place in range(first + 1, count):
            self._follow(self._view(place), is_last=place == count - 1)
        rows = self._block.rows
        anchors, motions, fitness = zip(*(self._rows[place] for place in range(first, count)), strict=True)
        pairs = np.array([(rows[i], rows[j]) for i, j, _ in self._steps], np.int64).reshape(-1, 2)
        return TrackedBlock(
            keys=rows[[key.place for key in self._keys]],
            clouds=tuple(key.cloud for key in self._keys),
            steps=Edges.of(pairs, "sequential").with_registrations([step for _, _, step in self._steps]),
            rows=rows[first:],
            anchors=rows[list(anchors)],
            key_from_row=np.array(motions),
            fitness=np.array(fitness),
            notes=tuple(note for place, note in self._notes.items() if note and place >= first),
        )

    def _view(self, place: int) -> _View:
        cloud, self._notes[place] = cloud_or_note(self._block.frames[place], self._options.followed)
        return _View(place, cloud, self._registrar.prepare(cloud))

    def _warm_up(self, start: _View) -> None:
        step = self._registrar.register(self._view(0).prepared, start.prepared, np.eye(4))
        if self._good(step):
            self._velocity = se3.log(step.i_from_j) / self._duration(0, start.place)

    def _begin(self, view: _View) -> None:
        """From here on this view is the key frame, and the last frame tracked."""
        options = self._options
        if options.clouds != options.followed and len(view.cloud):
            cloud = with_landmarks(view.cloud, self._block.frames[view.place], options.clouds)
            view = replace(view, cloud=cloud, prepared=self._registrar.prepare(cloud))
        self._keys.append(view)
        self._rows[view.place] = (view.place, np.eye(4), 1.0)
        self._last, self._key_from_last = view, np.eye(4)
        self._missed: _View | None = None

    def _promote(self, view: _View, step: Registration) -> None:
        self._steps.append((self._keys[-1].place, view.place, step))
        self._begin(view)

    def _follow(self, view: _View, is_last: bool) -> None:
        found = self._registered(self._keys[-1], view, self._key_from_last)
        if found.fitness < self._options.kept_fitness and self._last.place != self._keys[-1].place:
            found = self._from_last(view, found)
        if not self._good(found) and self._missed is not None:
            found = self._from_missed(view, self._missed, found)
        if not self._good(found):
            self._lose(view, is_last)
            return
        seconds = self._duration(self._last.place, view.place)
        self._velocity = se3.log(se3.inverse(self._key_from_last) @ found.i_from_j) / seconds
        self._rows[view.place] = (self._keys[-1].place, found.i_from_j, found.fitness)
        self._last, self._key_from_last, self._missed = view, found.i_from_j, None
        if is_last or self._has_moved(found.i_from_j):
            self._promote(view, found)

    def _from_last(self, view: _View, to_key: Registration) -> Registration:
        """The view seen from the last frame tracked, which becomes a key frame, where these two share more."""
        found = self._registered(self._last, view, np.eye(4))
        if found.fitness <= to_key.fitness or not self._good(found):
            return to_key
        _, key_from_last, _ = self._rows[self._last.place]
        step = self._registrar.register(self._keys[-1].prepared, self._last.prepared, key_from_last)
        self._promote(self._last, step)
        return found

    def _from_missed(self, view: _View, missed: _View, to_key: Registration) -> Registration:
        """Two frames that know each other but not the key frame: tracking is lost, and begins anew with the first."""
        found = self._registrar.register(missed.prepared, view.prepared, np.eye(4))
        if not self._good(found):
            return to_key
        self._promote(missed, self._guessed(missed))
        return found

    def _lose(self, view: _View, is_last: bool) -> None:
        """Its motion is a guess; the next frame tries the same key frame again."""
        guess = self._guessed(view)
        if is_last:
            self._promote(view, guess)
            return
        if len(view.cloud):
            self._missed = view
        self._rows[view.place] = (self._keys[-1].place, guess.i_from_j, np.nan)

    def _guessed(self, view: _View) -> Registration:
        motion = self._key_from_last @ self._ahead(view)
        return Registration(motion, np.zeros((6, 6)), 0.0, np.nan, 0, 0, False)

    def _registered(self, target: _View, source: _View, standing: Floats) -> Registration:
        """From a motion that goes on as before and, where that may not have worked, from `standing`, that of none."""
        step = self._registrar.register(target.prepared, source.prepared, standing @ self._ahead(source))
        if step.fitness < self._options.kept_fitness:
            again = self._registrar.register(target.prepared, source.prepared, standing)
            step = again if again.fitness > step.fitness else step
        return step

    def _good(self, step: Registration) -> bool:
        return step.fitness >= self._limits.min_fitness

    def _ahead(self, view: _View) -> Floats:
        seconds = min(self._duration(self._last.place, view.place), LONGEST_GUESS * self._usual_step)
        return se3.exp(self._velocity * seconds)

    def _duration(self, i: int, j: int) -> float:
        return max(float(self._block.times[j] - self._block.times[i]), 1e-6)

    def _has_moved(self, key_from_view: Floats) -> bool:
        moved = float(np.linalg.norm(key_from_view[:3, 3]))
        turned = float(np.linalg.norm(se3.so3_log(key_from_view[:3, :3])))
        return moved >= self._options.distance_m or turned >= self._options.angle_rad
