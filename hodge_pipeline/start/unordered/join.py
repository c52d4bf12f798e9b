"""The start `unordered`, and the joining of parts that odometry left disconnected."""

from __future__ import annotations

import shutil
from dataclasses import replace

import numpy as np
from pydantic.dataclasses import dataclass

from hodge_pipeline.complex.components import connected_components
from hodge_pipeline.registration.clouds import CloudOptions
from hodge_pipeline.registration.gaps import gaps
from hodge_pipeline.scene import START, Drift, KeyFrames, Round, Scene, sequences_of, vertex_ids
from hodge_pipeline.stages import OPTIONS, Step, Steps, Workers
from hodge_pipeline.start.clouds import landmarks_for, make_clouds
from hodge_pipeline.start.unordered.options import GlobalStart
from hodge_pipeline.start.unordered.start import Frames, Start, find_start
from hodge_pipeline.types import CloudSet, Edges, Source
from hodge_pipeline.types.notes import Note


@dataclass(frozen=True, config=OPTIONS)
class UnorderedStart(GlobalStart):
    """Matches frames or scans without a guess; nothing is taken from the order of the files or their stamps."""

    def begin(self, source: Source, clouds: CloudOptions, steps: Steps, workers: Workers) -> Scene:
        """Every frame of the source with its cloud and its pose by global registration."""
        made = make_clouds(source, landmarks_for(clouds, self), steps, workers)
        first = join_parts(source, made, None, None, self, steps, workers)
        key_frames = KeyFrames.all_of(source, first.world_from_cam)
        return Scene(source, source, key_frames, made, first, in_order=False)


def join_parts(
    source: Source,
    clouds: CloudSet,
    first: Round | None,
    drift: Drift | None,
    options: GlobalStart,
    steps: Steps,
    workers: Workers,
) -> Round:
    """The first round with its components, or all frames where it is None, joined by global registration.

    Within a component a match counts only as far as odometry may have drifted (`drift`).
    """
    edges = None if first is None else first.edges
    total = 2 * len(source.frames)
    found = steps.step(
        start_without_guess, source, clouds, edges, drift, options,
        title="start without a guess", total=total, workers=workers,
    )  # fmt: skip
    return Round(found.edges, vertex_ids(source), found.world_from_cam, name=START)


def start_without_guess(
    source: Source,
    clouds: CloudSet,
    edges: Edges | None,
    drift: Drift | None,
    options: GlobalStart,
    *,
    workers: Workers,
    step: Step,
) -> Start:
    """Step: the poses by global registration; where no two components of odometry are joined, those of odometry."""
    frames = Frames(source.frames, clouds.folder, vertex_ids(source), edges, drift)
    scratch = step.folder / "scratch"
    found = find_start(frames, options, scratch, workers, step.advance)
    shutil.rmtree(scratch, ignore_errors=True)
    step.note(*found.notes)
    if edges is not None and drift is not None and _keeps_odometry(source, edges, found):
        step.note(Note("left apart"))
        return replace(found, edges=edges, world_from_cam=drift.world_from_cam)
    return found


def _keeps_odometry(source: Source, edges: Edges, found: Start) -> bool:
    """Whether no two of several components were joined, and no hole in the stamps makes odometry's layout a guess."""
    parts = connected_components(edges.pairs, len(source.frames))
    if len(np.unique(parts)) == 1:
        return False
    stamps_s = np.array([frame.stamp_s for frame in source.frames])
    holes = len(gaps(list(sequences_of(source).values()), stamps_s)) > 0
    return not holes and len(np.unique(found.piece)) >= len(np.unique(parts))
