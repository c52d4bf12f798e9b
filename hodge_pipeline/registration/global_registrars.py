"""Registration of two clouds without a guess: FPFH matches and a consensus among them."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated

from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from hodge_pipeline.registration.consensus import rigid_consensus
from hodge_pipeline.registration.global_features import DescribedCloud, describe, mutual_matches
from hodge_pipeline.types import Match, PointCloud

TOLERANCE_VOXELS = 1.5
"""Distance of matched points at the right motion: each is the mean of its own voxel, whose diagonal is 1.7."""
MOST_POINTS = 12_000
"""Of a cloud at one of several scales: beyond it two take a second to match, and a coarser scale serves."""


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class FpfhConsensus:
    """Mutual FPFH matches, judged by how many others keep their distances: the same every time.

    At each of the `scales` the best motion and its rival are found; what the clouds show decides between them.
    """

    voxel_m: float = Field(
        default=0.05,
        gt=0,
        description="metres: the scale of the features. 0.05 serves rooms; about 1/60 of a scan's extent elsewhere",
    )
    scales: tuple[Annotated[float, Field(gt=0)], ...] = Field(
        default=(1.0, 2.0, 4.0),
        min_length=1,
        description="factors on voxel_m: a scanner's noise and rings hide small shapes, low overlap the large ones",
    )

    def describe(self, cloud: PointCloud) -> DescribedCloud:
        """The features of a cloud, coarser ones beside them."""
        *finer, coarsest = (factor * self.voxel_m for factor in self.scales)
        levels = [*(describe(cloud, voxel_m, MOST_POINTS) for voxel_m in finer), describe(cloud, coarsest)]
        return replace(levels[0], coarser=tuple(levels[1:]))

    def match(self, target: DescribedCloud, source: DescribedCloud) -> Match:
        """The motion of the source in the target whose inliers lead its rival's most, with the others as `others`."""
        found: list[Match] = []
        levels = zip((target, *target.coarser), (source, *source.coarser), self.scales, strict=True)
        for level_i, level_j, factor in levels:
            rows = mutual_matches(level_i, level_j)
            tolerance_m = TOLERANCE_VOXELS * factor * self.voxel_m
            best = rigid_consensus(level_i.points[rows[:, 0]], level_j.points[rows[:, 1]], tolerance_m)
            found.append(Match(best.i_from_j, best.count, len(rows), best.rival_count))
            if best.rival is not None:
                found.append(Match(best.rival.i_from_j, best.rival_count, len(rows), best.count))
        if len(self.scales) == 1:
            return found[0]
        first, *others = sorted(found, key=lambda one: one.rivals - one.inliers)
        return replace(first, others=tuple(others))
