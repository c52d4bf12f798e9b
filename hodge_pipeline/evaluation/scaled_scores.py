"""The scores of scenes that are no rooms: measured as if they were, with every length in another unit."""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.evaluation.scores import ScoreTable, edge_distances, score_table
from hodge_pipeline.stages import Workers
from hodge_pipeline.types import CloudSet, Floats, Ints


def scaled_score_table(
    clouds_folder: Path, pose_sets: Mapping[str, Floats], reference: str, workers: Workers, scale: float, scratch: Path
) -> ScoreTable:
    """The score table with the scores' own lengths times `scale`, its distances in metres; `scratch`: a new folder."""
    if scale == 1.0:
        return score_table(clouds_folder, pose_sets, reference, workers)
    with _clouds_in_units(clouds_folder, scale, scratch):
        sets = {name: se3.rescaled(poses, 1 / scale) for name, poses in pose_sets.items()}
        table = score_table(scratch, sets, reference, workers)
    graphs = tuple(replace(graph, distances_m=graph.distances_m * scale, scale=scale) for graph in table.graphs)
    return replace(table, graphs=graphs)


def scaled_distances(
    clouds_folder: Path, pairs: Ints, pose_sets: Floats, workers: Workers, scale: float, scratch: Path
) -> Floats:
    """How far apart (S, P) the clouds of pairs lie under sets of poses (S, N, 4, 4), in units of `scale` metres."""
    if scale == 1.0:
        return edge_distances(clouds_folder, pairs, pose_sets, workers)
    with _clouds_in_units(clouds_folder, scale, scratch):
        return edge_distances(scratch, pairs, se3.rescaled(pose_sets, 1 / scale), workers)


@contextmanager
def _clouds_in_units(folder: Path, scale: float, scratch: Path) -> Iterator[None]:
    clouds = CloudSet.open(folder)
    scratch.mkdir()
    smaller = (clouds.points / scale).astype(np.float32)
    CloudSet(
        clouds.offsets, smaller, clouds.normals, clouds.colours,
        clouds.marks, clouds.mark_points, clouds.mark_descriptors, clouds.mark_pixel_rad,
    ).save(scratch)  # fmt: skip
    try:
        yield
    finally:
        shutil.rmtree(scratch, ignore_errors=True)
