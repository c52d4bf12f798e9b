"""The step that makes the point clouds of all frames, with SIFT landmarks where frames are matched by images."""

from __future__ import annotations

from dataclasses import replace

from hodge_pipeline.registration.clouds import CloudOptions, prepare_clouds
from hodge_pipeline.stages import Step, Steps, Workers
from hodge_pipeline.start.unordered.options import GlobalStart
from hodge_pipeline.types import CloudSet, Source
from hodge_pipeline.types.notes import notes_of


def make_clouds(source: Source, options: CloudOptions, steps: Steps, workers: Workers) -> CloudSet:
    """The down-sampled cloud of each frame."""
    return steps.step(clouds, source, options, title="clouds", total=len(source.frames), workers=workers)


def clouds(source: Source, options: CloudOptions, *, workers: Workers, step: Step) -> CloudSet:
    """Step: the cloud of each frame by `registration.clouds`."""
    made, notes = prepare_clouds(source.frames, options, workers, step.advance)
    step.note(*notes_of("clouds", notes))
    return made


def landmarks_for(clouds: CloudOptions, matching: GlobalStart) -> CloudOptions:
    """The clouds with as many landmarks as matching without a guess wants, unless their own options say how many."""
    if matching.use == "geometry" or clouds.landmarks:
        return clouds
    return replace(clouds, landmarks=matching.landmarks)
