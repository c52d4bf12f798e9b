"""The step that makes the point clouds of all frames, with SIFT landmarks where frames are matched by images."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

from hodge_pipeline.registration.cloud_set import in_blocks, prepare_clouds
from hodge_pipeline.registration.clouds import CloudOptions, landmarks_of
from hodge_pipeline.stages import Step, Steps, Workers, in_order
from hodge_pipeline.start.unordered.options import GlobalStart
from hodge_pipeline.store import artifacts
from hodge_pipeline.store.codec import CLOUDS
from hodge_pipeline.types import CloudSet, Source


def make_clouds(source: Source, options: CloudOptions, steps: Steps, workers: Workers) -> CloudSet:
    """The down-sampled cloud of each frame."""
    return steps.step(clouds, source, options, title="clouds", total=len(source.frames), workers=workers)


def clouds(source: Source, options: CloudOptions, *, workers: Workers, step: Step) -> CloudSet:
    """Step: the cloud of each frame by `registration.cloud_set`."""
    made, notes = prepare_clouds(source.frames, options, workers, step.folder / CLOUDS, step.advance)
    step.note(*notes)
    return made


def with_landmarks(
    source: Source, made: CloudSet, options: CloudOptions, matching: GlobalStart, steps: Steps, workers: Workers
) -> CloudSet:
    """The clouds, made by these options, with landmarks of frames that are matched without a guess.

    Only then: SIFT costs more than all else of a key frame.
    """
    wanted = landmarks_for(options, matching)
    if wanted.landmarks == options.landmarks or not any(frame.read_colour for frame in source.frames):
        return made
    return steps.step(add_landmarks, source, made, wanted, title="landmarks", total=len(made), workers=workers)


def add_landmarks(source: Source, made: CloudSet, options: CloudOptions, *, workers: Workers, step: Step) -> CloudSet:
    """Step: the clouds (N) with landmarks of their frames (N); the files of their points are linked, not copied."""

    def counted_in(block: CloudSet) -> CloudSet:
        step.advance(len(block))
        return block

    folder, found = step.folder / CLOUDS, workers.map(partial(landmarks_of, options), in_blocks(source.frames))
    CloudSet.write(folder, map(counted_in, in_order(found)))
    for name in CloudSet.OF_POINTS:
        artifacts.link_or_copy(made.folder / f"{name}.npy", folder / f"{name}.npy")
    return CloudSet.open(folder)


def landmarks_for(clouds: CloudOptions, matching: GlobalStart) -> CloudOptions:
    """The clouds with as many landmarks as matching without a guess wants, unless their own options say how many."""
    if matching.use == "geometry" or clouds.landmarks:
        return clouds
    return replace(clouds, landmarks=matching.landmarks)
