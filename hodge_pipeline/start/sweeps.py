"""Initial poses of a spinning LiDAR: scan-to-map tracking of deskewed sweeps; only key frames enter the pose graph."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass as plain_dataclass
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from pydantic import Field
from pydantic.dataclasses import dataclass
from scipy.ndimage import maximum_filter1d

from hodge_pipeline import se3
from hodge_pipeline.complex.components import connected_components
from hodge_pipeline.errors import SourceError
from hodge_pipeline.registration.cloud_set import shortened
from hodge_pipeline.registration.clouds import CloudOptions, Oddity
from hodge_pipeline.registration.following import first_velocity, followed
from hodge_pipeline.registration.gaps import told_gaps
from hodge_pipeline.registration.odometry import REACHES_APART, Odometry, OdometryOptions, chained
from hodge_pipeline.registration.pairs import register_pairs
from hodge_pipeline.registration.scan_to_map import ScanToMap
from hodge_pipeline.registration.sweeps import (
    UNUSED,
    deskewed_frame,
    first_after_s,
    joined_frame,
    off_neighbours_m,
    retimed_frame,
    velocities,
)
from hodge_pipeline.scene import (
    KeyFrames,
    Scene,
    choose_key_frames,
    is_clock,
    sequence_numbers,
    sequences_of,
    stamps_of,
    vertex_ids,
)
from hodge_pipeline.stages import OPTIONS, Advance, Step, Steps, Workers
from hodge_pipeline.start.clouds import make_clouds
from hodge_pipeline.start.odometry import OdometryStart
from hodge_pipeline.start.sweep_reading import (
    LEFT_OUT,
    NO_CLOCK_S,
    REVOLUTION_S,
    begun_s,
    first_look,
    read_sweeps,
    timed_sweeps,
)
from hodge_pipeline.start.sweep_times import AS_TOLD, WARM_UP, finest_voxel_m, notes_of_times, times_along
from hodge_pipeline.types import Bools, CloudSet, Edges, Floats, Frame, Ints, PointCloud, Source
from hodge_pipeline.types.notes import Note, notes_of

KEY_FRAMES_IN_REACH = 40
"""The reach of the scanner over the key-frame distance: 2 m at 80 m."""
BESIDE = 0.1
"""Share of the reach within which a sweep beside a key frame lends it its points: 5 m on a street, a step at 50 m/s.
One after a hole is placed less well."""
STRANGE = "it fits none of the sweeps around it, and these fit each other: is it of another place?"
MOST_LOOSE = 0.5
"""Share of sweeps that tell little of how far the scanner went, above which the whole path is in doubt."""
MOST_SLIDING = 0.2
"""Share of sweeps that slide, above which it is, too. Of 75 simulated sequences that it was not chosen on, all 39 whose
length goes off by 4 % of the path or more have one of these shares or both, 22 that of loose ones; of 23 off by less
than 2 % none, of 13 between them five.
"""
UNEVEN_VOXELS, UNEVEN, GRIP_M_S2 = 0.2, 5.0, 9.81
"""A sweep is unevenly placed that lies farther off the motion from the one before to the one after than this share of
a voxel (alignments of 24 simulated sequences scatter by up to 0.12), than as many times what is usual around there, and
than an acceleration of 1 g moves it, more than tyres hold. Turns are not judged: one that sets in on the spot, at 90
degrees a second, is as far off as a false one of 4 degrees."""
IN_MAP_REACH = 0.1
"""Share of the reach by which the middles of sweeps move, at the median, and twice as far as the scanner, where they
are in map coordinates: of a scanner at rest they move with what passes, of one in motion it moves by more."""
TOLD = 5
"""Unevenly placed sweeps that are named."""


@plain_dataclass(frozen=True)
class Sweeps:
    """Poses (N, 4, 4) of all sweeps at their stamps, their velocities (N, 6), and which (N,) were read.

    `revolution_s` and `sense` (N,) are how the times of points are read (`retimed_frame`);
    `reach_m` is how far the scanner sees: 99 % of a usual sweep's points are nearer.
    """

    world_from_scan: Floats
    velocity: Floats
    found: Bools
    revolution_s: Floats
    sense: Ints
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
            retimed_frame(frame, revolution_s, sense)
            for frame, revolution_s, sense in zip(
                source.frames, found.revolution_s.tolist(), found.sense.tolist(), strict=True
            )
        ]
        frames = tuple(map(deskewed_frame, timed, found.velocity))
        whole = replace(source, frames=frames)
        steps.remember(whole, steps.key([source, found]) + "deskewed")
        apart_m = found.reach_m / KEY_FRAMES_IN_REACH if self.distance_m is None else self.distance_m
        rows = key_rows(found, sequences, apart_m, self.angle_deg)
        steps.note(Note("key frames", len(rows), str(len(frames))))
        thick = thickened(whole, rows, found, sequences, clouds)
        steps.remember(thick, steps.key([whole, rows]) + "thickened")
        made = make_clouds(thick, clouds, steps, workers)
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


def thickened(whole: Source, rows: Ints, found: Sweeps, sequences: tuple[Ints, ...], clouds: CloudOptions) -> Source:
    """The key frames, each with the points of the sweep before it and of the one after, where these are near.

    Pairs of single sweeps are pulled ring on ring: along a simulated street they are off by up to 0.05 degrees of pitch
    and 0.3 cm of height on average, of three sweeps each by less than 0.01 degrees and 0.1 cm.
    """
    frames = {}
    for part in sequences:
        read = part[found.found[part]]
        for place in np.flatnonzero(np.isin(read, rows)).tolist():
            row, around = read[place], np.delete(read[max(place - 1, 0) : place + 2], min(place, 1))
            key_from_sweep = se3.inverse(found.world_from_scan[row]) @ found.world_from_scan[around]
            apart_m = np.linalg.norm(key_from_sweep[:, :3, 3], axis=1)
            near = (apart_m > 0) & (apart_m < BESIDE * found.reach_m)  # a sweep that is written twice lends nothing
            frames[row] = joined_frame(
                whole.frames[row], [whole.frames[other] for other in around[near]], key_from_sweep[near], clouds
            )
    return replace(whole, frames=tuple(frames[row] for row in rows))


def follow(
    source: Source, sequences: tuple[Ints, ...], clouds: CloudOptions, voxel_m: float | None, *, step: Step
) -> Sweeps:
    """Step: the poses of all sweeps, each sequence by itself. Raises `SourceError` where none has points in range."""
    count, stamps = len(source.frames), stamps_of(source)
    poses, velocity = np.tile(np.eye(4), (count, 1, 1)), np.zeros((count, 6))
    found, loose, sliding, parts = *np.zeros((3, count), bool), list[_Followed]()
    revolution_s, sense = np.zeros(count), np.ones(count, np.int64)
    for rows in sequences:
        part = _follow_one([source.frames[row] for row in rows], stamps[rows], clouds, voxel_m, step.advance)
        poses[rows], velocity[rows] = part.world_from_scan, part.velocity
        found[rows], loose[rows], sliding[rows] = part.found, part.loose, part.sliding
        revolution_s[rows], sense[rows] = part.revolution_s, part.sense
        parts.append(part)
    odd = [one for part in parts for one in part.odd]
    if not found.any():
        raise SourceError(f"{source.path}: none of the {count} sweeps gave points in range; the first: {odd[0]}")
    step.note(*notes_of("clouds", shortened(odd)))
    if not found.all():
        first = next(one for one in odd if one.what == LEFT_OUT)
        step.note(Note("sweeps left out", int((~found).sum()), f"{first.frame}: {first.why}"))
    if loose.any() or sliding.any():
        most = loose.sum() > MOST_LOOSE * found.sum() or sliding.sum() > MOST_SLIDING * found.sum()
        step.note(Note("path loose" if most else "sweeps loose", int((loose | sliding).sum()), str(count)))
    jumps = [one for part in parts for one in part.jumps]
    if jumps:
        step.note(Note("sweeps uneven", len(jumps), ", ".join(jumps[:TOLD]) + ", …" * (len(jumps) > TOLD)))
    in_map_m = max(part.in_map_m for part in parts)
    if in_map_m:
        step.note(Note("sweeps in map", 1, f"{in_map_m:.3g} m"))
    clocked = [rows for rows in sequences if is_clock(stamps[rows])]
    step.note(*told_gaps(clocked, stamps, vertex_ids(source)))
    step.note(*notes_of_times(revolution_s, sense))
    if not any(part.is_timed for part in parts):
        step.note(Note("sweeps untimed"))
    return Sweeps(poses, velocity, found, revolution_s, sense, min(part.reach_m for part in parts))


class _Followed(NamedTuple):
    """One sequence: poses (M, 4, 4) at the stamps, velocities (M, 6), which (M,) sweeps were read, where (M,) the
    alignment was loose, and where it slid; whether points have times; how these are read (`retimed_frame`); the reach
    of the scanner in metres; what is odd; sweeps off the even motion around them; metres by which the middles of sweeps
    move where these seem to be in map coordinates, else 0.
    """

    world_from_scan: Floats
    velocity: Floats
    found: Bools
    loose: Bools
    sliding: Bools
    is_timed: bool
    revolution_s: float
    sense: int
    reach_m: float
    odd: list[Oddity]
    jumps: list[str]
    in_map_m: float


def _follow_one(
    frames: list[Frame], stamps_s: Floats, clouds: CloudOptions, voxel_m: float | None, advance: Advance
) -> _Followed:
    """One sequence, its points timed as told; followed again where its fastest sweeps are sure of other times."""
    look = first_look(frames, stamps_s, clouds)
    voxel = voxel_m or finest_voxel_m(look.reach_m)
    times = begun_s(stamps_s, 0.0 if look.revolution_s else look.turn_s)
    part = _follow_as_told(frames, times, clouds, voxel, look.reach_m, advance)
    read = np.flatnonzero(part.found)
    turning = begun_s(stamps_s, look.turn_s)
    velocity = part.velocity[read] * (times[-1] / turning[-1] if turning[-1] else 1.0)
    told = times_along([frames[row] for row in read], velocity, turning[read], clouds, voxel, look, advance)
    if told == AS_TOLD:
        return part
    times = turning if told[1] != UNUSED else begun_s(stamps_s, 0.0)
    again = [retimed_frame(frame, *told) for frame in frames]
    advance(-len(frames))
    part = _follow_as_told(again, times, clouds, voxel, look.reach_m, advance)
    return part._replace(revolution_s=told[0], sense=told[1])


def _follow_as_told(
    frames: list[Frame], times: Floats, clouds: CloudOptions, voxel_m: float, usual_m: float, advance: Advance
) -> _Followed:
    count, is_timed, rows, odd = len(frames), False, list[int](), list[Oddity]()
    poses, velocity, middle_s = np.tile(np.eye(4), (count, 1, 1)), np.zeros((count, 6)), np.zeros(count)
    found, loose, sliding, original = *np.zeros((3, count), bool), np.arange(count)
    jumps, middles, in_map_m = list[str](), np.zeros((count, 3)), 0.0
    begun, spread, strange = first_velocity(voxel_m, timed_sweeps(frames[:WARM_UP], times, clouds, usual_m))
    tracker = ScanToMap(voxel_m, begun, spread, tells_slides=True)

    def read() -> Iterator[tuple[int, float, PointCloud]]:
        latest = 0
        for row, sweep in enumerate(read_sweeps(frames, clouds, usual_m)):
            odd.extend([] if sweep.odd is None else [sweep.odd])
            original[row] = latest if sweep.is_copy else row
            if row in strange:
                odd.append(Oddity(frames[row].frame_id, LEFT_OUT, STRANGE))
            elif sweep.cloud is not None:
                latest = row
                middles[row] = np.median(sweep.cloud.points_in_cam, axis=0)
                middle_s[row] = first_after_s(sweep.cloud, frames[row].stamp_s)
                yield row, times[row], sweep.cloud
            advance(1)

    for row, placed in followed(tracker, read()):
        if placed is None:
            odd.append(Oddity(frames[row].frame_id, LEFT_OUT, STRANGE))
            continue
        poses[row], loose[row], sliding[row] = placed.pose, placed.is_loose, tracker.slides
        is_timed |= placed.turn_s > 0
        middle_s[row] += placed.turn_s / 2
        rows.append(row)
    if rows:
        found[rows] = True
        found = found[original]
        last = np.maximum(np.searchsorted(rows, np.arange(count), side="right") - 1, 0)
        velocity = velocities(poses[rows], times[rows])[last]
        is_numbered = not is_timed and not is_clock(np.array([frame.stamp_s for frame in frames]))
        seconds = times[rows] * (REVOLUTION_S / NO_CLOCK_S if is_numbered else 1.0)
        jumps = _jumps([str(frames[row].frame_id) for row in rows], poses[rows], seconds, voxel_m)
        in_map_m = _in_map_m(middles[rows], poses[rows], usual_m)
        poses = poses[rows][last] @ se3.exp(-middle_s[rows][last][:, None] * velocity)  # to the stamp
    return _Followed(poses, velocity, found, loose, sliding, is_timed, *AS_TOLD, usual_m, odd, jumps, in_map_m)


def _in_map_m(middles: Floats, poses: Floats, reach_m: float) -> float:
    """Metres by which the middles (N, 3) of sweeps move while the scanner hardly does by its poses (N, 4, 4), as where
    sweeps are in map coordinates; else 0.
    """
    moved_m, found_m = (
        float(np.median(np.linalg.norm(places - places[0], axis=1))) for places in (middles, poses[:, :3, 3])
    )
    return moved_m if moved_m > max(IN_MAP_REACH * reach_m, 2 * found_m) else 0.0


def _jumps(names: list[str], poses: Floats, times_s: Floats, voxel_m: float) -> list[str]:
    """Names of the sweeps that lie off the even motion around them, and how far."""
    off_m, usual_m = off_neighbours_m(poses, times_s)
    around = np.diff(times_s, prepend=np.nan) * np.diff(times_s, append=np.nan)
    uneven = off_m > np.maximum(UNEVEN_VOXELS * voxel_m, UNEVEN * usual_m)
    uneven &= off_m > GRIP_M_S2 / 2 * around  # never at the ends
    uneven &= off_m >= maximum_filter1d(off_m, 3)  # a displaced pose puts those beside it off by half
    return [f"{names[row]}: {off_m[row]:.2f} m" for row in np.flatnonzero(uneven)]


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
