"""A run that starts from given poses: which they are, its key frames, and how it begins between sparse ones."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from pathlib import Path

import numpy as np

from hodge_pipeline.errors import RecipeError, SourceError
from hodge_pipeline.refine.correction import spread_correction
from hodge_pipeline.refine.given_poses import Given, Matched, match_poses, own_poses
from hodge_pipeline.refine.key_frames import choose_key_frames
from hodge_pipeline.registration import clouds as cloud_stage
from hodge_pipeline.registration import odometry as odometry_stage
from hodge_pipeline.rounds import Round, sequences_of
from hodge_pipeline.sources.inspect import guess_reader
from hodge_pipeline.store import artifacts
from hodge_pipeline.store.job import Job
from hodge_pipeline.store.workspace import key_of
from hodge_pipeline.types import Floats, Source, Trajectory, ViewGraph

SAME_M = 1e-6


def given_poses(job: Job, source: Source) -> Given:
    """The poses that the recipe starts from, for every frame, and the key frames.

    Raises `RecipeError` where no file is named, `SourceError` where its poses are not of these frames.
    """
    options = job.recipe.given
    path, trajectory = None, None
    if options.poses == "frames":
        matched = own_poses(source.frames)
        if not len(matched.pose_times):
            raise SourceError(f"{source.path}: its frames have no poses: give a file of them (given.path)")
    else:
        path = options.path
        if path is None:
            raise RecipeError("given.path: no file of poses named: give one, or set given.poses to frames")
        trajectory = _trajectory(job, path)
        matched = match_poses(trajectory, source.frames, options, str(path))
    known = np.isfinite(matched.world_from_cam).all(axis=(1, 2))
    _tell(job, matched, int(known.sum()), len(source.frames))
    poses = matched.world_from_cam if known.all() else _bridged(job, source, matched)
    rows = choose_key_frames(poses, list(sequences_of(source).values()), job.recipe.key_frames)
    job.note(f"{len(rows)} of {len(source.frames)} frames are key frames")
    job.keys["source"] = key_of(job.keys["source"], rows.tolist(), digest(poses))
    return Given(source, poses, rows, matched.frame_times, matched.pose_times, path, trajectory)


def first_poses(job: Job, given: Given, source: Source) -> Round:
    """Round 0: the given poses of the key frames, with no edge yet."""
    poses = given.world_from_cam[given.key_rows]
    with job.stage("start", "given poses", 1, digest(poses), ("clouds",)) as (_, advance):
        advance(1)
    ids = np.array([frame.frame_id for frame in source.frames])
    none = ViewGraph.from_edges(ids, np.zeros((0, 2), np.int64), np.zeros((0, 4, 4)))
    return Round(none, poses, name="start")


def key_source(given: Given, own: bool) -> Source:
    """The key frames as a source. Where the run starts from the frames' `own` poses these are no truth to compare with.

    Nor are they where the file holds the very poses that the frames have, as a SLAM system's log beside its images.
    """
    frames = tuple(given.whole.frames[row] for row in given.key_rows)
    poses = given.world_from_cam[given.key_rows]
    same = [
        frame.world_from_cam is not None and np.abs(frame.world_from_cam - pose).max() < SAME_M
        for frame, pose in zip(frames, poses, strict=True)
    ]
    if own or sum(same) > len(same) / 2:
        frames = tuple(replace(frame, world_from_cam=None) for frame in frames)
    return replace(given.whole, frames=frames, graph=None)


def _trajectory(job: Job, path: Path) -> Trajectory:
    opened = guess_reader(path).open(path)
    if opened.graph is not None and opened.graph.edge_count:
        raise SourceError(f"{path}: a graph of measured edges, which needs no frames: give it to hodge solve")
    for note in opened.notes:
        job.note(f"{path.name}: {note}")
    if opened.trajectory is not None:
        return opened.trajectory
    posed = [(frame.stamp_s, frame.world_from_cam) for frame in opened.frames if frame.world_from_cam is not None]
    if not posed:
        raise SourceError(f"{path}: has no poses to start from: give a trajectory; a graph goes to hodge solve")
    stamps = np.array([stamp for stamp, _ in posed])
    if (np.diff(stamps) <= 0).any():
        raise SourceError(f"{path}: several sequences with stamps of their own: give one sequence's poses")
    return Trajectory(stamps, np.array([pose for _, pose in posed]))


def _tell(job: Job, matched: Matched, known: int, frames: int) -> None:
    job.note(f"{known} of {frames} frames have a given pose, by {matched.how}; {len(matched.pose_times)} poses given")


def _bridged(job: Job, source: Source, matched: Matched) -> Floats:
    """A pose for every frame: between the given ones the odometry's, bent so that it meets them.

    Where frames of a sequence have no given pose at all, the correction of the nearest given pose holds.
    """
    missing = np.flatnonzero(~np.isfinite(matched.world_from_cam).all(axis=(1, 2)))
    job.note(f"{len(missing)} frames without a given pose are carried from the nearest ones by odometry")
    clouds, options = job.recipe.clouds, job.recipe.odometry
    stamps = np.array([frame.stamp_s for frame in source.frames])
    given_key = digest(matched.world_from_cam)
    stage = job.stage("bridge", "poses between the given ones", len(stamps), (clouds, options, given_key), ("source",))
    with stage as (folder, advance):
        if not folder.finished:
            with job.workers() as workers:
                made, _ = cloud_stage.prepare_clouds(source.frames, clouds, workers)
                made.save(folder.path)
                sequences = list(sequences_of(source).values())
                found = odometry_stage.odometry(folder.path, sequences, stamps, options, workers, advance)
            for note in found.notes:
                job.note(note)
            artifacts.save_arrays(folder.path / "poses.npz", {"world_from_cam": found.world_from_cam})
    odometry = artifacts.load_arrays(job.path("bridge") / "poses.npz")["world_from_cam"]
    known = np.setdiff1d(np.arange(len(stamps)), missing)
    given = matched.world_from_cam[known]
    return spread_correction(np.arange(len(stamps), dtype=float), odometry, known.astype(float), odometry[known], given)


def digest(poses: Floats) -> str:
    """A short name of these very numbers."""
    return hashlib.sha256(np.ascontiguousarray(poses).tobytes()).hexdigest()
