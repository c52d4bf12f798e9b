"""Initial poses of a spinning LiDAR: scan-to-map tracking of deskewed sweeps; only key frames enter the pose graph."""

from __future__ import annotations

from dataclasses import dataclass as plain_dataclass
from dataclasses import replace
from typing import Any

import numpy as np
import small_gicp
from pydantic import Field
from pydantic.dataclasses import dataclass

from hodge_pipeline import se3
from hodge_pipeline.complex.components import connected_components
from hodge_pipeline.errors import SourceError
from hodge_pipeline.registration.assessment import MIN_POINTS
from hodge_pipeline.registration.clouds import CloudOptions, make_cloud
from hodge_pipeline.registration.odometry import REACHES_APART, Odometry, OdometryOptions, chained
from hodge_pipeline.registration.pairs import register_pairs
from hodge_pipeline.registration.sweeps import deskewed, deskewed_frame, velocities
from hodge_pipeline.scene import (
    KeyFrames,
    Scene,
    has_real_stamps,
    key_source,
    sequence_numbers,
    sequences_of,
    stamps_of,
)
from hodge_pipeline.stages import Step, Steps, Workers
from hodge_pipeline.start.choose_key_frames import choose_key_frames
from hodge_pipeline.start.clouds import make_clouds
from hodge_pipeline.start.odometry import OPTIONS, OdometryStart
from hodge_pipeline.types import Bools, CloudSet, Edges, Floats, Frame, Ints, PointCloud, Source
from hodge_pipeline.types.notes import Note, notes_of

VOXELS_IN_REACH, KEY_FRAMES_IN_REACH = 100, 40
"""0.8 m, as KISS-ICP (Vizzo et al., RA-L 2023) has it, and 2 m for a scanner that sees 80 m."""
SMALLEST_VOXEL_M = 0.08
"""Four times the usual noise of a range, 2 cm: smaller voxels, as in a room, would hold noise in place of surfaces."""
START_LEVELS, LEVELS = (9, 3, 1), (3, 1)
"""Voxels of the map, coarse to fine: the coarsest are for a velocity of 30 m a second that nobody knows yet."""
LOOK_M, SAMPLE_M = 3.0, 0.7
"""Times a voxel: how far correspondences may be at its level; and the finest voxel thins a sweep."""
NEIGHBOURS, MOST_ITERATIONS, SWEEPS_KEPT = 10, 30, 100
"""As small_gicp has them: points in a covariance; steps at a level; sweeps until a voxel that no sweep touches goes."""
REACH_QUANTILE = 0.99
WARM_UP, MOST_PASSES = 20, 4
"""Sweeps that the first velocity is found on, and how often at most they are followed forth and back for it."""
MOST_DESKEWS, FARTHER = 3, 0.9
"""A sweep is deskewed again while its new velocity moves its farther points, at this quantile, by half a voxel."""
NO_CLOCK_S = 1.0
"""Between two sweeps that neither stamps nor times of points tell apart: velocities are then a sweep's."""


@plain_dataclass(frozen=True)
class Sweeps:
    """Poses (N, 4, 4) of all sweeps at their first points, their velocities (N, 6), and which (N,) were read.

    `reach_m` is how far the scanner sees: 99 % of the first sweep's points are nearer.
    """

    world_from_scan: Floats
    velocity: Floats
    found: Bools
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
        frames = tuple(map(deskewed_frame, source.frames, found.velocity))
        whole = replace(source, frames=frames)
        steps.remember(whole, steps.key([source, found]) + "deskewed")
        apart_m = found.reach_m / KEY_FRAMES_IN_REACH if self.distance_m is None else self.distance_m
        rows = choose_key_frames(found.world_from_scan, sequences, apart_m, self.angle_deg, 0)
        rows = rows[found.found[rows]]
        keys = key_source(whole, rows)
        steps.remember(keys, steps.key([whole, rows]))
        steps.note(Note("key frames", len(rows), str(len(frames))))
        made = make_clouds(keys, clouds, steps, workers)
        steps_of = tuple(np.flatnonzero(np.isin(rows, part)) for part in sequences)
        joined = steps.step(
            register_steps, made, steps_of, found.world_from_scan[rows], self.odometry,
            title="odometry", total=max(1, len(rows) - len(sequences)), workers=workers,
        )  # fmt: skip
        key_frames = _followers(whole, rows, found, joined, sequences)
        return self.joined(whole, made, clouds, joined, key_frames, steps, workers)


def follow(
    source: Source, sequences: tuple[Ints, ...], clouds: CloudOptions, voxel_m: float | None, *, step: Step
) -> Sweeps:
    """Step: the poses of all sweeps, each sequence by itself."""
    count = len(source.frames)
    poses, velocity = np.tile(np.eye(4), (count, 1, 1)), np.zeros((count, 6))
    found, turn_s = np.zeros(count, bool), np.zeros(count)
    stamps, is_clock = stamps_of(source), has_real_stamps(source.frames)
    reach_m = _reach_m(source, clouds)
    notes: list[str] = []
    voxel = voxel_m or max(reach_m / VOXELS_IN_REACH, SMALLEST_VOXEL_M)
    for rows in sequences:
        since = np.diff(stamps[rows], prepend=stamps[rows[0]]) if is_clock else np.zeros(len(rows))
        first = [source.frames[row] for row in rows[:WARM_UP]]
        tracker = _Tracker(clouds, voxel, LEVELS, _first_velocity(clouds, voxel, first, since))
        times = np.zeros(len(rows))
        for place, row in enumerate(rows.tolist()):
            duration, problem = tracker.follow(source.frames[row], since[place])
            times[place] = times[place - 1] + duration if place else 0.0
            poses[row], found[row], turn_s[row] = tracker.pose, not problem, tracker.turn_s
            notes += [f"frame {source.frames[row].frame_id}: {problem}"] if problem else []
            step.advance(1)
        velocity[rows] = velocities(poses[rows], times)
        from_middle = se3.exp(-turn_s[rows, None] / 2 * velocity[rows])
        poses[rows] = poses[rows] @ from_middle  # to the first point
    step.note(*notes_of("clouds", notes))
    if not turn_s.any():
        step.note(Note("sweeps untimed"))
    return Sweeps(poses, velocity, found, reach_m)


def _reach_m(source: Source, clouds: CloudOptions) -> float:
    """How far the scanner sees in the first sweep that can be read. Raises `SourceError` where none can."""
    problem: object = "the source has no points"
    for frame in source.frames:
        try:
            points = _sweep(frame, clouds).points_in_cam
        except (SourceError, OSError) as error:
            problem = error
            continue
        ranges = np.linalg.norm(points, axis=1)
        ranges = ranges[(ranges >= clouds.min_range_m) & (ranges <= clouds.max_range_m)]
        if len(ranges):
            return float(np.quantile(ranges, REACH_QUANTILE))
    raise SourceError(f"{source.path}: none of the {len(source.frames)} sweeps gave points in range: {problem}")


def _sweep(frame: Frame, clouds: CloudOptions) -> PointCloud:
    """The points of a sweep as measured; the cloud of a frame that has a depth image in their place."""
    return make_cloud(frame, clouds)[0] if frame.read_points is None else frame.read_points()


class _Tracker:
    """Scan to map on one sequence: `pose` is that at the middle of the last sweep, which took `turn_s`, if known.

    Sweeps are deskewed to their middle, where a wrong velocity moves them as little forwards as back. To their first
    points it would move the next pose the other way by half, which swings for ever.
    """

    def __init__(self, clouds: CloudOptions, voxel_m: float, levels: tuple[int, ...], velocity: Floats) -> None:
        self._clouds, self._voxel_m, self._map = clouds, voxel_m, _Map(voxel_m, levels)
        self.velocity, self.pose, self.turn_s = velocity, np.eye(4), 0.0

    def follow(self, frame: Frame, since_s: float, *, backwards: bool = False) -> tuple[float, str]:
        """The seconds since the last sweep, a revolution where no clock says (`since_s` 0), and what kept this one from
        being read.
        """
        try:
            cloud = _in_range(_sweep(frame, self._clouds), self._clouds)
        except (SourceError, OSError) as error:
            return since_s or self.turn_s or NO_CLOCK_S, str(error)
        if not len(cloud):
            return since_s or self.turn_s or NO_CLOCK_S, "it has no points in range"
        self.turn_s = 0.0 if cloud.times_s is None else float(cloud.times_s.max())
        duration, sense = since_s or self.turn_s or NO_CLOCK_S, -1.0 if backwards else 1.0
        before, velocity, rates = self.pose, self.velocity, [self.velocity]
        for _ in range(MOST_DESKEWS):
            points = deskewed(cloud, sense * rates[-1], self.turn_s / 2).points_in_cam.astype(np.float64)
            self.pose, is_first = self._map.align(points, before @ se3.exp(velocity * duration))
            if is_first:
                break
            velocity = se3.log(se3.inverse(before) @ self.pose) / duration
            rates.append(velocity)
            if not self.turn_s or self._shift_m(rates[-1] - rates[-2], points) < self._voxel_m / 2:
                break
        self._map.insert(self.pose)
        self.velocity = velocity
        return duration, ""

    def _shift_m(self, rates: Floats, points: Floats) -> float:
        """How far such an error of the velocity moves the farther points at the ends of a sweep."""
        range_m = np.quantile(np.linalg.norm(points, axis=1), FARTHER)
        return float((np.linalg.norm(rates[:3]) * range_m + np.linalg.norm(rates[3:])) * self.turn_s / 2)


def _in_range(cloud: PointCloud, options: CloudOptions) -> PointCloud:
    ranges = np.linalg.norm(cloud.points_in_cam, axis=1)  # NaN compares false
    kept = (ranges > 0) & (ranges >= options.min_range_m) & (ranges <= options.max_range_m)
    times_s = None if cloud.times_s is None else cloud.times_s[kept]
    return PointCloud(cloud.points_in_cam[kept], times_s=times_s)


def _first_velocity(clouds: CloudOptions, voxel_m: float, frames: list[Frame], since_s: Floats) -> Floats:
    """The twist a second (6,) at the first of these frames, which are followed forth and back until it stays.

    At first from rest: rings on the ground look the same ahead, and give a velocity that is too small.
    """
    velocity = np.zeros(6)
    for _ in range(MOST_PASSES):
        before = velocity
        for is_back in (False, True):
            tracker = _Tracker(clouds, voxel_m, START_LEVELS, velocity)
            places = range(len(frames))
            for place in reversed(places) if is_back else places:
                since = since_s[place + is_back] if place + is_back < len(since_s) else 0.0
                duration, _ = tracker.follow(frames[place], since, backwards=is_back)
            velocity = -tracker.velocity
        if np.linalg.norm((velocity - before)[3:]) * duration < voxel_m / 2:
            break
    return velocity


class _Map:
    """Voxels of Gaussians (Koide et al., ICRA 2021) of the sweeps so far, at several sizes, coarse to fine."""

    def __init__(self, voxel_m: float, levels: tuple[int, ...]) -> None:
        self._voxel_m, self._is_empty, self._sweep = voxel_m, True, None
        self._levels = [(size * voxel_m, small_gicp.GaussianVoxelMap(size * voxel_m)) for size in levels]
        for _, voxels in self._levels:
            voxels.set_lru(horizon=SWEEPS_KEPT)

    def align(self, points: Floats, guess: Floats) -> tuple[Floats, bool]:
        """The pose of a sweep by points (N, 3), and whether there was nothing to align, so that it is the guess."""
        self._sweep = self._thinned(points) if len(points) >= MIN_POINTS else None
        if self._sweep is None or self._is_empty:
            return guess, True
        coarse = guess
        for level in self._levels[:-1]:
            found = np.asarray(self._aligned(level, coarse).T_target_source)
            coarse = found if se3.is_motion(found) else coarse
        both = [self._aligned(self._levels[-1], start) for start in (guess, coarse)]
        best = min(both, key=lambda found: found.error / max(found.num_inliers, 1) ** 2)  # near, and many
        return (np.asarray(best.T_target_source) if best.num_inliers >= MIN_POINTS else guess), False

    def _aligned(self, level: tuple[float, Any], guess: Floats) -> Any:
        size_m, voxels = level
        return small_gicp.align(
            voxels,
            self._sweep,
            guess,
            max_correspondence_distance=LOOK_M * size_m,
            max_iterations=MOST_ITERATIONS,
        )

    def insert(self, pose: Floats) -> None:
        """The sweep aligned last joins the map."""
        if self._sweep is None:
            return
        for _, voxels in self._levels:
            voxels.insert(self._sweep, pose)
        self._is_empty = False

    def _thinned(self, points: Floats) -> Any:
        sweep = small_gicp.voxelgrid_sampling(points, SAMPLE_M * self._voxel_m)
        small_gicp.estimate_covariances(sweep, None, NEIGHBOURS)
        return sweep


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
        step.note(Note("path broken", breaks, str(breaks)))
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
