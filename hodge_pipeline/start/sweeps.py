"""Initial poses of a spinning LiDAR: scan-to-map tracking of deskewed sweeps; only key frames enter the pose graph."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass as plain_dataclass
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from pydantic import Field
from pydantic.dataclasses import dataclass

from hodge_pipeline import se3
from hodge_pipeline.complex.components import connected_components
from hodge_pipeline.errors import SourceError
from hodge_pipeline.registration.cloud_set import FACTOR_OF_UNITS, shortened
from hodge_pipeline.registration.clouds import CloudOptions, Oddity, in_range, make_cloud, out_of_range, reach_m
from hodge_pipeline.registration.gaps import told_gaps
from hodge_pipeline.registration.odometry import REACHES_APART, Odometry, OdometryOptions, chained
from hodge_pipeline.registration.pairs import register_pairs
from hodge_pipeline.registration.scan_to_map import ScanToMap, first_velocity, followed, is_backwards
from hodge_pipeline.registration.sweeps import deskewed_frame, first_after_s, turned_frame, velocities
from hodge_pipeline.scene import (
    KeyFrames,
    Scene,
    is_clock,
    key_source,
    sequence_numbers,
    sequences_of,
    stamps_of,
    vertex_ids,
)
from hodge_pipeline.stages import Advance, Step, Steps, Workers
from hodge_pipeline.start.choose_key_frames import choose_key_frames
from hodge_pipeline.start.clouds import make_clouds
from hodge_pipeline.start.odometry import OPTIONS, OdometryStart
from hodge_pipeline.types import Bools, CloudSet, Edges, Floats, Floats32, Frame, Ints, PointCloud, Source
from hodge_pipeline.types.notes import Note, notes_of

VOXELS_IN_REACH, KEY_FRAMES_IN_REACH = 100, 40
"""The reach of the scanner over the voxel and over the key-frame distance: 0.8 m, as in KISS-ICP (Vizzo et al., RA-L
2023), and 2 m at 80 m."""
SMALLEST_VOXEL_M = 0.08
"""Four times the usual noise of a range, 2 cm: smaller voxels, as in a room, would hold noise in place of surfaces."""
WARM_UP = 20
"""Sweeps that the first velocity is found on."""
LEFT_OUT = "the sweep is left out"
STRANGE = "it fits none of the sweeps around it, and these fit each other: is it of another place?"
MOST_LOOSE = 0.5
"""Share of sweeps that tell little of how far the scanner went, above which the whole path is in doubt."""
LOOKS = 9
"""Sweeps, spread over a sequence, that tell how far its scanner sees: any one may face a wall."""
MOST_SKIPPED = 20
"""Revolutions, 2 s of most scanners: numbers of files that are farther apart as a rule count something else."""
STEPS_AROUND = 5
"""Steps before and after a sweep for its median velocity: half a second, in which a car hardly changes its speed."""
NO_CLOCK_S = 1.0
"""Time of a step where neither stamps nor times of points give one: velocities are then per sweep."""


@plain_dataclass(frozen=True)
class Sweeps:
    """Poses (N, 4, 4) of all sweeps at their stamps, their velocities (N, 6), and which (N,) were read.

    `backwards` (N,) is where the times of points are turned;
    `reach_m` is how far the scanner sees: 99 % of a usual sweep's points are nearer.
    """

    world_from_scan: Floats
    velocity: Floats
    found: Bools
    backwards: Bools
    reach_m: float


@dataclass(frozen=True, config=OPTIONS)
class SweepsStart(OdometryStart):
    """Follows a spinning LiDAR: each sweep, deskewed, is registered to a map of those before (voxelised GICP)."""

    voxel_m: float | None = Field(
        default=None,
        gt=0,
        description="metres: finest voxels of the map; none: a hundredth of the scanner's reach, 0.08 m or more",
    )
    distance_m: float | None = Field(
        default=None, ge=0, description="metres from one key frame to the next; none: a fortieth of the scanner's reach"
    )
    angle_deg: float = Field(default=15.0, ge=0, description="degrees, likewise")

    def begin(self, source: Source, clouds: CloudOptions, steps: Steps, workers: Workers) -> Scene:
        """The key frames of a sequence of sweeps, with deskewed clouds and poses."""
        sequences = tuple(sequences_of(source).values())
        found = steps.step(follow, source, sequences, clouds, self.voxel_m, title="sweeps", total=len(source.frames))
        timed = [
            turned_frame(frame) if is_turned else frame
            for frame, is_turned in zip(source.frames, found.backwards, strict=True)
        ]
        frames = tuple(map(deskewed_frame, timed, found.velocity))
        whole = replace(source, frames=frames)
        steps.remember(whole, steps.key([source, found]) + "deskewed")
        apart_m = found.reach_m / KEY_FRAMES_IN_REACH if self.distance_m is None else self.distance_m
        rows = key_rows(found, sequences, apart_m, self.angle_deg)
        keys = key_source(whole, rows)
        steps.remember(keys, steps.key([whole, rows]))
        steps.note(Note("key frames", len(rows), str(len(frames))))
        made = make_clouds(keys, clouds, steps, workers)
        steps_of = tuple(own for part in sequences if len(own := np.flatnonzero(np.isin(rows, part))))
        joined = steps.step(
            register_steps, made, steps_of, found.world_from_scan[rows], self.odometry,
            title="odometry", total=max(1, len(rows) - len(sequences)), workers=workers,
        )  # fmt: skip
        key_frames = _followers(whole, rows, found, joined, sequences)
        return replace(self.joined(whole, made, clouds, joined, key_frames, steps, workers), steps_stand=True)


def key_rows(found: Sweeps, sequences: tuple[Ints, ...], apart_m: float, angle_deg: float) -> Ints:
    """Rows of the key frames among the sweeps that were found: the first and the last of each sequence are some."""
    read = [rows[found.found[rows]] for rows in sequences if found.found[rows].any()]
    return choose_key_frames(found.world_from_scan, read, apart_m, angle_deg, 0)


def follow(
    source: Source, sequences: tuple[Ints, ...], clouds: CloudOptions, voxel_m: float | None, *, step: Step
) -> Sweeps:
    """Step: the poses of all sweeps, each sequence by itself. Raises `SourceError` where none has points in range."""
    count, stamps = len(source.frames), stamps_of(source)
    poses, velocity = np.tile(np.eye(4), (count, 1, 1)), np.zeros((count, 6))
    found, loose, parts = np.zeros(count, bool), np.zeros(count, bool), list[_Followed]()
    backwards = np.zeros(count, bool)
    for rows in sequences:
        part = _follow_one([source.frames[row] for row in rows], stamps[rows], clouds, voxel_m, step.advance)
        poses[rows], velocity[rows] = part.world_from_scan, part.velocity
        found[rows], loose[rows], backwards[rows] = part.found, part.loose, part.backwards
        parts.append(part)
    odd = [one for part in parts for one in part.odd]
    if not found.any():
        raise SourceError(f"{source.path}: none of the {count} sweeps gave points in range; the first: {odd[0]}")
    step.note(*notes_of("clouds", shortened(odd)))
    if not found.all():
        first = next(one for one in odd if one.what == LEFT_OUT)
        step.note(Note("sweeps left out", int((~found).sum()), f"{first.frame}: {first.why}"))
    if loose.any():
        kind = "path loose" if loose.sum() > MOST_LOOSE * found.sum() else "sweeps loose"
        step.note(Note(kind, int(loose.sum()), str(count)))
    clocked = [rows for rows in sequences if is_clock(stamps[rows])]
    step.note(*told_gaps(clocked, stamps, vertex_ids(source)))
    if backwards.any():
        step.note(Note("times backwards", int(backwards.sum()), str(count)))
    if not any(part.is_timed for part in parts):
        step.note(Note("sweeps untimed"))
    return Sweeps(poses, velocity, found, backwards, min(part.reach_m for part in parts))


class _Followed(NamedTuple):
    """One sequence: poses (M, 4, 4) at the stamps, velocities (M, 6), which (M,) sweeps were read, where (M,) the
    alignment was loose; whether points have times, and these are turned; the reach of the scanner in metres; what is
    odd.
    """

    world_from_scan: Floats
    velocity: Floats
    found: Bools
    loose: Bools
    is_timed: bool
    backwards: bool
    reach_m: float
    odd: list[Oddity]


def _follow_one(
    frames: list[Frame], stamps_s: Floats, clouds: CloudOptions, voxel_m: float | None, advance: Advance
) -> _Followed:
    count, is_timed, rows, odd = len(frames), False, list[int](), list[Oddity]()
    poses, velocity, middle_s = np.tile(np.eye(4), (count, 1, 1)), np.zeros((count, 6)), np.zeros(count)
    found, loose, original = np.zeros(count, bool), np.zeros(count, bool), np.arange(count)
    usual_m, usual_turn_s = _first_look(frames, clouds)
    times = _times(stamps_s, usual_turn_s)
    voxel = voxel_m or max(usual_m / VOXELS_IN_REACH, SMALLEST_VOXEL_M)
    warm_up = _timed_sweeps(frames[:WARM_UP], times, clouds, usual_m)
    begun, strange = first_velocity(voxel, warm_up)
    backwards = is_backwards(voxel, begun, [one for one in warm_up if one[0] not in strange])
    if backwards:
        frames = [turned_frame(frame) for frame in frames]
        begun, strange = first_velocity(voxel, _timed_sweeps(frames[:WARM_UP], times, clouds, usual_m))
    tracker = ScanToMap(voxel, begun)

    def read() -> Iterator[tuple[int, float, PointCloud]]:
        latest = 0
        for row, sweep in enumerate(_sweeps(frames, clouds, usual_m)):
            odd.extend([] if sweep.odd is None else [sweep.odd])
            original[row] = latest if sweep.is_copy else row
            if row in strange:
                odd.append(Oddity(frames[row].frame_id, LEFT_OUT, STRANGE))
            elif sweep.cloud is not None:
                latest = row
                middle_s[row] = first_after_s(sweep.cloud, frames[row].stamp_s)
                yield row, times[row], sweep.cloud
            advance(1)

    for row, placed in followed(tracker, read()):
        if placed is None:
            odd.append(Oddity(frames[row].frame_id, LEFT_OUT, STRANGE))
            continue
        poses[row], loose[row], is_timed = placed.pose, placed.is_loose, is_timed or placed.turn_s > 0
        middle_s[row] += placed.turn_s / 2
        rows.append(row)
    if rows:
        found[rows] = True
        found = found[original]
        last = np.maximum(np.searchsorted(rows, np.arange(count), side="right") - 1, 0)
        velocity = velocities(poses[rows], times[rows])[last]
        poses = poses[rows][last] @ se3.exp(-middle_s[rows][last][:, None] * velocity)  # to the stamp
    return _Followed(poses, velocity, found, loose, is_timed, backwards, usual_m, odd)


def _timed_sweeps(
    frames: list[Frame], times: Floats, clouds: CloudOptions, usual_m: float
) -> list[tuple[int, float, PointCloud]]:
    """Row, time of its beginning and points of each sweep that can be read."""
    every = enumerate(_sweeps(frames, clouds, usual_m))
    return [(row, times[row], sweep.cloud) for row, sweep in every if sweep.cloud]


def deskewed_along(source: Source, world_from_scan: Floats, clouds: CloudOptions, steps: Steps) -> Source:
    """The source with sweeps whose points have times deskewed to their stamps, by velocities from poses (N, 4, 4).

    The poses may be noisy: a velocity is the median over the steps around. Notes where sweeps in motion have no times.
    """
    velocity, stamps, is_untimed = np.zeros((len(source.frames), 6)), stamps_of(source), False
    for rows in sequences_of(source).values():
        middle = source.frames[rows[len(rows) // 2]]
        turn_s = _first_look([middle], clouds)[1] if middle.read_points is not None else 0.0
        turns = len(rows) > 1 and is_clock(stamps[rows]) and np.median(np.diff(stamps[rows])) < NO_CLOCK_S
        is_untimed |= bool(turns and not turn_s and middle.read_points is not None)
        if turn_s and len(rows) > 1:
            apart_s = np.diff(_times(stamps[rows], turn_s))
            moved = se3.log(se3.inverse(world_from_scan[rows[:-1]]) @ world_from_scan[rows[1:]]) / apart_s[:, None]
            velocity[rows] = [
                np.median(moved[max(0, row - STEPS_AROUND) : row + STEPS_AROUND], axis=0) for row in range(len(rows))
            ]
    if is_untimed:
        steps.note(Note("sweeps untimed"))
    if not velocity.any():
        return source
    return replace(source, frames=tuple(map(deskewed_frame, source.frames, velocity)))


class _Sweep(NamedTuple):
    """The points in range of a sweep, None where it cannot be read or repeats the one before it, and what is odd."""

    cloud: PointCloud | None
    odd: Oddity | None = None
    is_copy: bool = False


def _sweeps(frames: Iterable[Frame], clouds: CloudOptions, usual_m: float | None = None) -> Iterator[_Sweep]:
    """Each sweep in range; without points where it cannot be read, repeats the last one, or has a reach far from
    `usual_m`, which means other units.
    """
    before: Frame | None = None
    points: Floats32 = np.zeros((0, 3), np.float32)
    for frame in frames:
        try:
            # The points as measured; the cloud of a frame that has a depth image in their place.
            cloud = make_cloud(frame, clouds)[0] if frame.read_points is None else frame.read_points()
            near = in_range(cloud, clouds)
        except (SourceError, OSError) as error:
            yield _Sweep(None, Oddity(frame.frame_id, LEFT_OUT, str(error)))
            continue
        if not len(near):
            yield _Sweep(None, Oddity(frame.frame_id, LEFT_OUT, out_of_range(cloud, clouds)))
        elif usual_m is not None and not 1 / FACTOR_OF_UNITS < (reach := reach_m(cloud)) / usual_m < FACTOR_OF_UNITS:
            why = f"it reaches {reach:.3g} m, the others {usual_m:.3g} m: has it other units (millimetres)?"
            yield _Sweep(None, Oddity(frame.frame_id, LEFT_OUT, why))
        elif before is not None and np.array_equal(near.points_in_cam, points):
            why = f"it is given the pose of {before.frame_id}"
            yield _Sweep(None, Oddity(frame.frame_id, "holds the same points as the sweep before it", why), True)
        else:
            before, points = frame, near.points_in_cam
            yield _Sweep(near)


def _first_look(frames: list[Frame], clouds: CloudOptions) -> tuple[float, float]:
    """Median reach in metres and duration of a revolution in seconds (0: unknown) of a few sweeps; `max_range_m` where
    none can be read.
    """
    looks = [s.cloud for s in _sweeps(frames[:: max(1, len(frames) // LOOKS)], clouds) if s.cloud is not None]
    looks = looks or [s.cloud for s in _sweeps(frames, clouds) if s.cloud is not None][:1]
    if not looks:
        return clouds.max_range_m, 0.0
    reach = np.median([reach_m(look) for look in looks])
    return float(reach), float(np.median([0.0 if look.times_s is None else look.times_s.max() for look in looks]))


def _times(stamps_s: Floats, turn_s: float) -> Floats:
    """When sweeps (N,) began, in seconds after the first: by their stamps, or by their numbers, a revolution each."""
    after: Floats = stamps_s - stamps_s[0]
    if len(after) < 2 or is_clock(stamps_s):
        return after
    step = float(np.median(np.diff(after)))
    return np.asarray((after if step <= MOST_SKIPPED else after / step) * (turn_s or NO_CLOCK_S))


def register_steps(
    clouds: CloudSet,
    sequences: tuple[Ints, ...],
    world_from_key: Floats,
    options: OdometryOptions,
    *,
    workers: Workers,
    step: Step,
) -> Odometry:
    """Step: each key frame joined to the one before it by the motion that the map gave, which is more exact than a
    registration of the two clouds; fitness and information are those of that registration.
    """
    assert clouds.folder is not None
    pairs = np.concatenate([np.stack([rows[:-1], rows[1:]], axis=1) for rows in sequences]).astype(np.int64)
    guesses = se3.inverse(world_from_key[pairs[:, 0]]) @ world_from_key[pairs[:, 1]]
    edges = register_pairs(
        clouds.folder, options.registration, Edges.of(pairs, "sequential"), guesses, workers, step.advance
    )
    held = edges.fitness >= options.min_fitness
    if not held.all():
        breaks = int((~held).sum())
        step.note(Note("path broken", breaks, str(breaks + 1)))
    edges = replace(edges, i_from_j=guesses)
    space_m = REACHES_APART * clouds.reach_m
    poses = chained(len(world_from_key), sequences, edges, space_m)
    return Odometry(poses, edges.select(held), ())


def _followers(source: Source, rows: Ints, found: Sweeps, joined: Odometry, sequences: tuple[Ints, ...]) -> KeyFrames:
    """How all sweeps of the source move with the key frames, each with the last one before it."""
    number = sequence_numbers(source)
    anchor = np.clip(np.searchsorted(rows, np.arange(len(source.frames)), side="right") - 1, 0, len(rows) - 1)
    first_of = np.array([np.searchsorted(rows, part[0]) for part in sequences])
    anchor = np.maximum(anchor, np.minimum(first_of[number], len(rows) - 1))
    key_from_frame = se3.inverse(found.world_from_scan[rows[anchor]]) @ found.world_from_scan
    poses = joined.world_from_cam
    part = connected_components(joined.steps.pairs, len(rows))
    return KeyFrames(
        rows=rows, first=poses[anchor] @ key_from_frame, world_from_key=poses, part=part[anchor],
        times=np.arange(len(source.frames), dtype=float), found=found.found, stamps_s=stamps_of(source),
        sequence=number, key_of_frame=anchor,
    )  # fmt: skip
