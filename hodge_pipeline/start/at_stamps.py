"""The step that moves landmarks to where they were at the stamps of their frames, by the velocities of the camera."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from hodge_pipeline.registration.descriptors import LOWE_RATIO, match, root_sift
from hodge_pipeline.registration.pixels import project
from hodge_pipeline.registration.tracking.readout import MOST_VIEWS, Readout, estimate_readout, with_readout
from hodge_pipeline.registration.tracking.shutter import at_frame_stamp
from hodge_pipeline.registration.tracking.sightings import View
from hodge_pipeline.scene import has_real_stamps
from hodge_pipeline.stages import Step, Steps
from hodge_pipeline.store import artifacts
from hodge_pipeline.store.codec import CLOUDS
from hodge_pipeline.types import CloudSet, Floats, Floats32, Frame, Ints, Source
from hodge_pipeline.types.arrays import evenly
from hodge_pipeline.types.notes import Note


def with_landmarks_at_stamps(
    source: Source, made: CloudSet, world_from_cam: Floats, twists: Floats, pairs: Ints, unit_m: float, steps: Steps
) -> CloudSet:
    """The clouds of all frames (N), their landmarks moved to where they were at the stamps of the frames, by the
    velocities `twists (N, 6)`. As they are without a clock, or where all pixels are of the moment of the stamp.
    """
    late = any(frame.colour_delay_s or (frame.camera and frame.camera.readout_s) for frame in source.frames)
    if not late or not len(made.mark_points) or not has_real_stamps(source.frames):
        return made
    title = "landmarks at the stamps of frames"
    return steps.step(at_stamps, source, made, world_from_cam, twists, pairs, unit_m, title=title)


def at_stamps(
    source: Source, made: CloudSet, world_from_cam: Floats, twists: Floats, pairs: Ints, unit_m: float, *, step: Step
) -> CloudSet:
    """Step: the clouds (N), their landmarks moved, by their camera's read-out unless those of `pairs (P, 2)` surely fit
    another; all other files are linked, not copied.

    `world_from_cam (N, 4, 4)`: where the fit starts; `twists (N, 6)`: see `shutter.velocities`; `unit_m`: length units
    per metre.
    """
    frames, readout = source.frames, None
    if any(frame.camera and frame.camera.readout_s for frame in frames):
        moves = np.asarray(twists.any(axis=1))
        pairs = pairs[moves[pairs].all(axis=1)]
        views = landmark_views(made, frames, pairs[evenly(len(pairs), MOST_VIEWS)])
        readout = estimate_readout(views, frames, world_from_cam, twists, unit_m)
    if readout is not None:
        step.note(other_readout(readout))
    folder = step.folder / CLOUDS
    folder.mkdir(exist_ok=True)  # a killed run left it
    for name in set(CloudSet.FILES) - {"mark_points"}:
        artifacts.link_or_copy(made.folder / f"{name}.npy", folder / f"{name}.npy")
    readout_s = None if readout is None else readout.best_s
    np.save(folder / "mark_points.npy", landmarks_at_stamps(frames, made, twists, readout_s))
    return CloudSet.open(folder)


def landmark_views(clouds: CloudSet, frames: Sequence[Frame], pairs: Ints) -> Iterator[View]:
    """What the second frame of each pair (P, 2) saw of the landmarks of the first."""
    for i, j in pairs.tolist():
        first, second, camera = clouds[i].landmarks, clouds[j].landmarks, frames[j].camera
        if first is not None and second is not None and camera is not None:
            rows_i, rows_j = match(root_sift(first.descriptors), root_sift(second.descriptors), LOWE_RATIO).T
            points, seen = (
                np.asarray(own, float) for own in (first.points_in_cam[rows_i], second.points_in_cam[rows_j])
            )
            yield View(i, j, points, project(seen, camera))


def other_readout(found: Readout) -> Note:
    """The note that landmarks contradict the camera's own read-out."""
    return Note("other readout", detail=f"{1e3 * found.best_s:.0f} ms")


def landmarks_at_stamps(frames: Sequence[Frame], clouds: CloudSet, twists: Floats, readout_s: float | None) -> Floats32:
    """The landmarks (Q, 3) of the clouds of these frames (K), where they were at the stamps of their frames.

    `twists (K, 6)`: see `shutter.velocities`; `readout_s` takes the place of the cameras' own read-out.
    """
    points = np.array(clouds.mark_points)
    for row, frame in enumerate(frames):
        own = slice(*clouds.marks[row : row + 2].tolist())
        if frame.camera is not None:
            camera = with_readout(frame.camera, readout_s)
            points[own] = at_frame_stamp(points[own].astype(float), camera, frame.colour_delay_s, twists[row])
    return points
