"""The poses of all frames, once those of the key frames are solved."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hodge_pipeline.complex.components import in_runs
from hodge_pipeline.registration.tracking.readout import with_readout
from hodge_pipeline.registration.tracking.reposing import PosedBlock, repose_stored
from hodge_pipeline.registration.tracking.shutter import LONGEST_SPAN_S, velocities
from hodge_pipeline.registration.tracking.smoothing import VIDEO_STEP_S, smoothed
from hodge_pipeline.scene import KeyFrames, Scene, stamps_of, vertex_ids
from hodge_pipeline.stages import Step, Steps, Workers
from hodge_pipeline.types import Floats, Source
from hodge_pipeline.types.notes import Note


def pose_all_frames(scene: Scene, world_from_key: Floats, steps: Steps, workers: Workers, unit_m: float) -> Floats:
    """Poses (N, 4, 4) of all frames that follow from those (K, 4, 4) of the key frames; `unit_m` is as of `resect`."""
    poses = scene.key_frames.expand(world_from_key)
    if scene.sightings is None:
        return poses
    return steps.step(
        pose_frames, scene.whole, scene.key_frames, scene.sightings, poses, unit_m, title="all frames",
        total=len(poses), workers=workers,
    )  # fmt: skip


def pose_frames(
    source: Source,
    key_frames: KeyFrames,
    sightings: Path,
    world_from_cam: Floats,
    unit_m: float,
    *,
    workers: Workers,
    step: Step,
) -> Floats:
    """Step: the frames between key frames resected by their sightings, or left at their poses (N, 4, 4) with too few
    inliers; the path is then smoothed.
    """
    twists = velocities(world_from_cam, stamps_of(source), key_frames.sequence, key_frames.found)
    is_key = np.zeros(len(world_from_cam), bool)
    is_key[key_frames.rows] = True
    poses, information, misfits = world_from_cam.copy(), np.zeros((len(world_from_cam), 6, 6)), list[int]()

    def block(path: Path) -> PosedBlock:
        with np.load(path) as own:
            rows = np.union1d(own["key"], own["frame"])
        frames = [source.frames[row] for row in rows]
        readout_s = key_frames.readout_s
        cameras = tuple(with_readout(frame.camera, readout_s) for frame in frames if frame.camera is not None)
        delays_s = np.array([frame.colour_delay_s for frame in frames])
        return PosedBlock(rows, world_from_cam[rows], is_key[rows], twists[rows], cameras, delays_s, unit_m)

    paths = sorted(sightings.glob("*.npz"))
    for _, found in workers.map(repose_stored, [(path, block(path)) for path in paths]):
        poses[found.rows] = found.world_from_cam
        information[found.rows] = found.information
        misfits.extend(found.misfits.tolist())
        step.advance(len(found.rows) + len(found.misfits))
    if misfits:
        names = in_runs(np.array(sorted(misfits)), vertex_ids(source))
        step.note(Note("misfits", len(misfits), names))
    return _smooth(poses, information, stamps_of(source), key_frames)


def _smooth(world_from_cam: Floats, information: Floats, stamps_s: Floats, key_frames: KeyFrames) -> Floats:
    """Every unbroken run of tracked frames, smoothed; a frame that was not resected has the usual information.

    A path with longer steps than a video's is left as it is: a hand turns back between two frames.
    """
    posed = np.asarray(information.any(axis=(1, 2)))
    rows, out = np.flatnonzero(key_frames.found), world_from_cam.copy()
    step_s = np.diff(stamps_s[rows])
    if not posed.any() or not len(step_s) or np.median(step_s) > VIDEO_STEP_S:
        return out
    information = np.where(posed[:, None, None], information, _usual(information[posed]))
    joined = (np.diff(key_frames.part[rows]) == 0) & (np.diff(key_frames.sequence[rows]) == 0)
    broken = ~joined | (step_s <= 0) | (step_s > LONGEST_SPAN_S)
    for run in np.split(rows, np.flatnonzero(broken) + 1):
        out[run] = smoothed(world_from_cam[run], information[run], stamps_s[run])
    return out


def _usual(information: Floats) -> Floats:
    """The mean (6, 6) of information (N, 6, 6) scaled to trace 1, times the median trace: unlike a median of entries it
    is positive definite, as each of them is.
    """
    trace = np.einsum("nii->n", information)
    return np.asarray(np.median(trace) * (information / trace[:, None, None]).mean(axis=0))
