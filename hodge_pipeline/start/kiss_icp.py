"""Initial poses of a spinning LiDAR by KISS-ICP with deskewed sweeps; only key frames enter the pose graph."""

from __future__ import annotations

from dataclasses import dataclass as plain_dataclass
from dataclasses import replace
from typing import Any

import numpy as np
from pydantic import Field
from pydantic.dataclasses import dataclass

from hodge_pipeline import se3
from hodge_pipeline.complex.components import connected_components
from hodge_pipeline.errors import RecipeError, SourceError
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
"""KISS-ICP's own default, and 2 m for a scanner that sees 80 m: neighbours share nearly all they see."""
REACH_QUANTILE = 0.99
WARM_UP = 10
"""Sweeps, a second, until a tracker knows its way: it begins at rest, and rings on the ground look the same ahead."""
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
class KissIcpStart(OdometryStart):
    """Follows a spinning LiDAR by KISS-ICP (Vizzo et al., RA-L 2023); needs `pip install hodge-pipeline[lidar]`."""

    voxel_m: float | None = Field(
        default=None, gt=0, description="metres: voxels of the local map; none: a hundredth of the scanner's reach"
    )
    distance_m: float | None = Field(
        default=None, ge=0, description="metres from one key frame to the next; none: a fortieth of the scanner's reach"
    )
    angle_deg: float = Field(default=15.0, ge=0, description="degrees, likewise")

    def begin(self, source: Source, clouds: CloudOptions, steps: Steps, workers: Workers) -> Scene:
        """The key frames of a sequence of sweeps, with deskewed clouds and poses."""
        sequences = tuple(sequences_of(source).values())
        found = steps.step(follow, source, sequences, clouds, self.voxel_m, title="KISS-ICP", total=len(source.frames))
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
        return self.joined(whole, made, joined, key_frames, steps, workers)


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
    for rows in sequences:
        voxel = voxel_m or reach_m / VOXELS_IN_REACH
        since = np.diff(stamps[rows], prepend=stamps[rows[0]]) if is_clock else np.zeros(len(rows))
        tracker = _Tracker(clouds, voxel)
        times = np.zeros(len(rows))
        for place, row in enumerate(rows.tolist()):
            duration, problem = tracker.follow(source.frames[row], since[place])
            times[place] = times[place - 1] + duration if place else 0.0
            poses[row], found[row], turn_s[row] = tracker.pose, not problem, tracker.turn_s
            notes += [f"frame {source.frames[row].frame_id}: {problem}"] if problem else []
            step.advance(1)
        first = rows[: 2 * WARM_UP]
        behind = _from_behind(_Tracker(clouds, voxel, backwards=True), [source.frames[row] for row in first], since)
        anew, join = first[: len(first) // 2], len(first) // 2
        poses[anew] = poses[first[join]] @ se3.inverse(behind[join]) @ behind[:join]
        velocity[rows] = velocities(poses[rows], times)
        poses[rows] = poses[rows] @ se3.exp(
            -turn_s[rows, None] / 2 * velocity[rows]
        )  # from the middle to the first point
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
    """KISS-ICP on one sequence: `pose` is that at the middle of the last sweep, `turn_s` how long that took, if known.

    Sweeps are deskewed to their middle, where a wrong velocity moves them as little forwards as back. To their first
    points it would move the next pose the other way by half, which swings for ever.
    """

    def __init__(self, clouds: CloudOptions, voxel_m: float, *, backwards: bool = False) -> None:
        self._clouds, self._sense = clouds, -1.0 if backwards else 1.0
        self._kiss, self._velocity, self.pose, self.turn_s = _kiss_icp(clouds, voxel_m), np.zeros(6), np.eye(4), 0.0

    def follow(self, frame: Frame, since_s: float) -> tuple[float, str]:
        """The seconds since the last sweep, a revolution where no clock says (`since_s` 0), and what kept this one from
        being read.
        """
        try:
            cloud = _sweep(frame, self._clouds)
        except (SourceError, OSError) as error:
            return since_s or self.turn_s or NO_CLOCK_S, str(error)
        if not len(cloud):
            return since_s or self.turn_s or NO_CLOCK_S, "it has no points"
        self.turn_s = 0.0 if cloud.times_s is None else float(cloud.times_s.max())
        duration = since_s or self.turn_s or NO_CLOCK_S
        points = deskewed(cloud, self._sense * self._velocity, self.turn_s / 2).points_in_cam.astype(np.float64)
        before = self.pose
        self._kiss.register_frame(points[np.isfinite(points).all(axis=1)], np.zeros(0))
        self.pose = np.array(self._kiss.last_pose)
        self._velocity = se3.log(se3.inverse(before) @ self.pose) / duration
        return duration, ""


def _from_behind(tracker: _Tracker, frames: list[Frame], since_s: Floats) -> Floats:
    """Poses (n, 4, 4) of the first frames of a sequence, each at the middle of its sweep, followed from the last one
    back to the first by a new tracker: by then its map is full.
    """
    poses = np.tile(np.eye(4), (len(frames), 1, 1))
    for place in reversed(range(len(frames))):
        tracker.follow(frames[place], since_s[place + 1] if place + 1 < len(frames) else 0.0)
        poses[place] = tracker.pose
    return poses


def _kiss_icp(clouds: CloudOptions, voxel_m: float) -> Any:
    try:
        from kiss_icp.config import KISSConfig
        from kiss_icp.kiss_icp import KissICP
    except ImportError as error:
        raise RecipeError(
            "start kiss_icp needs the package kiss-icp: pip install hodge-pipeline[lidar], or take start.stage=odometry"
        ) from error
    config = KISSConfig()
    config.data.min_range, config.data.max_range = clouds.min_range_m, clouds.max_range_m
    config.data.deskew = False
    config.mapping.voxel_size = voxel_m
    config.registration.max_num_threads = 1
    return KissICP(config)


def register_steps(
    clouds: CloudSet,
    sequences: tuple[Ints, ...],
    world_from_key: Floats,
    options: OdometryOptions,
    *,
    workers: Workers,
    step: Step,
) -> Odometry:
    """Step: each key frame registered to the one before it, from the motion that KISS-ICP found."""
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
    motions = np.where(held[:, None, None], edges.i_from_j, guesses)
    space_m = REACHES_APART * clouds.reach_m
    poses = chained(len(world_from_key), sequences, replace(edges, i_from_j=motions), space_m)
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
