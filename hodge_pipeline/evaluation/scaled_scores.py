"""The scores of scenes that are no rooms: measured as if they were, with every length in another unit."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from hodge_pipeline.evaluation.scores import ScoreTable, score_table
from hodge_pipeline.stages import Workers
from hodge_pipeline.types import CloudSet, Floats


def scaled_score_table(
    clouds_folder: Path, pose_sets: Mapping[str, Floats], reference: str, workers: Workers, scale: float, scratch: Path
) -> ScoreTable:
    """The score table with the scores' own lengths times `scale`, its distances in metres; `scratch`: a new folder."""
    if scale == 1.0:
        return score_table(clouds_folder, pose_sets, reference, workers)
    clouds = CloudSet.open(clouds_folder)
    scratch.mkdir()
    smaller = (clouds.points / scale).astype(np.float32)
    CloudSet(
        clouds.offsets, smaller, clouds.normals, clouds.colours,
        clouds.marks, clouds.mark_points, clouds.mark_descriptors,
    ).save(scratch)  # fmt: skip
    table = score_table(
        scratch, {name: _in_units(poses, scale) for name, poses in pose_sets.items()}, reference, workers
    )
    shutil.rmtree(scratch, ignore_errors=True)
    graphs = tuple(replace(graph, distances_m=graph.distances_m * scale, scale=scale) for graph in table.graphs)
    return replace(table, graphs=graphs)


def _in_units(world_from_cam: Floats, scale: float) -> Floats:
    out: Floats = world_from_cam.copy()
    out[..., :3, 3] /= scale
    return out
