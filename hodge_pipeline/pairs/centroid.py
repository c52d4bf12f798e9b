"""Pairs of frames whose clouds have their centroids close together (the paper's first rule)."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass
from scipy.spatial import cKDTree

from hodge_pipeline import se3
from hodge_pipeline.pairs.candidates import NO_PAIRS, usable_rows
from hodge_pipeline.types import CloudSet, Edges, Floats, Frame, PointCloud


def centroids_in_world(clouds: Iterable[PointCloud], world_from_cam: Floats) -> Floats:
    """The mean point (N, 3) of each cloud, metres, under its pose (N, 4, 4)."""
    means = np.array([cloud.points_in_cam.mean(axis=0, dtype=float) for cloud in clouds]).reshape(-1, 1, 3)
    return se3.transform(world_from_cam, means)[:, 0]


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class CentroidEdges:
    """Pairs the frames whose clouds have nearby centroids."""

    max_distance_m: float = Field(
        0.2, gt=0, description="metres between the two centroids in the world frame; 0.2 is the paper's"
    )

    def propose(self, frames: Sequence[Frame], clouds: CloudSet, world_from_cam: Floats) -> Edges:
        """Pairs of centroids less than `max_distance_m` apart; none for frames without points or a finite pose."""
        rows = usable_rows(clouds, world_from_cam)
        if len(rows) < 2:
            return Edges.proposed(NO_PAIRS, "centroid")
        tree = cKDTree(centroids_in_world(clouds.read(rows), world_from_cam[rows]))
        return Edges.proposed(rows[tree.query_pairs(self.max_distance_m, output_type="ndarray")], "centroid")
