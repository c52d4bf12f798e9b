"""Loop closures by appearance, however far odometry has drifted between the frames."""

from __future__ import annotations

import shutil
from dataclasses import replace

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.diagnosis.diagnosis import diagnose
from hodge_pipeline.pairs.drift import median_range_m, path_length_m
from hodge_pipeline.pairs.revisits import LOOP_RANGES, Revisits
from hodge_pipeline.scene import Drift, vertex_ids
from hodge_pipeline.solvers.backbone.trust import SEQUENTIAL
from hodge_pipeline.stages import Step, Workers
from hodge_pipeline.start.unordered.options import GlobalStart
from hodge_pipeline.start.unordered.start import Frames, tried, weighed_matches
from hodge_pipeline.types import CloudSet, Edges, Source, ViewGraph
from hodge_pipeline.types.notes import Note

SIMILAR_PER_FRAME = 3
"""Frames that each is matched with, 4 ms a pair: a few loops are enough, from which revisits find the others."""


def is_long(clouds: CloudSet, odometry: Edges, drift: Drift, revisits: Revisits) -> bool:
    """Whether drift along the path may exceed the reach of `revisits`, which is metric."""
    range_m = median_range_m(clouds, np.flatnonzero(clouds.sizes > 0))
    way_m = se3.displacement_m(se3.between(drift.world_from_cam, odometry.pairs), range_m).sum()
    return bool(way_m > revisits.longest_way_m)


def find_loops(
    source: Source,
    clouds: CloudSet,
    odometry: Edges,
    drift: Drift,
    revisits: Revisits,
    options: GlobalStart,
    *,
    workers: Workers,
    step: Step,
) -> Edges:
    """Step: loop closures by matched landmarks, between one frame per `revisits.every_m` metres of the path.

    Those are kept that the diagnosis of all, with odometry as the trusted backbone, keeps.
    """
    ids, seeing = vertex_ids(source), clouds.sizes > 0
    range_m = median_range_m(clouds, np.flatnonzero(seeing))
    stretch = np.floor(path_length_m(drift.world_from_cam, range_m) / revisits.every_m)
    rows = np.flatnonzero(seeing)[np.unique(stretch[seeing], return_index=True)[1]]
    reach = int(np.ceil(LOOP_RANGES * range_m / revisits.every_m))
    scratch = step.folder / "scratch"
    frames = Frames(source.frames, clouds.folder, ids, odometry, drift)
    few = replace(options, all_pairs_up_to=0, similar_per_frame=SIMILAR_PER_FRAME, reach=reach, loops=())
    weighed, _ = weighed_matches(frames, rows, few, scratch, workers, step.advance)
    shutil.rmtree(scratch, ignore_errors=True)
    found = weighed.select(weighed.counts)
    step.note(Note("start", detail=f"loops by what frames look like: {tried(len(rows), weighed)}"))
    if not len(found):
        return found
    graph = ViewGraph.joined([odometry.as_graph(ids), found.as_graph(ids)])
    kept = diagnose(graph, replace(options.diagnosis, trust=SEQUENTIAL)).kept[len(odometry) :]
    return found.select(kept)
