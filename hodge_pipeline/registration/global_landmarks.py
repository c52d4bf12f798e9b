"""Registration of two RGB-D frames with no guess: landmarks whose descriptors match, and one motion explains."""

from __future__ import annotations

from dataclasses import dataclass as plain_dataclass

import numpy as np
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from hodge_pipeline.registration.consensus import rigid_consensus
from hodge_pipeline.registration.descriptors import match, root_sift
from hodge_pipeline.types import Bytes, Floats32, Landmarks, Match, PointCloud


@plain_dataclass(frozen=True)
class DescribedImage:
    """The landmarks of one frame: `points_in_cam (n, 3)`, SIFT descriptors (n, 128) as bytes."""

    points_in_cam: Floats32
    sift: Bytes

    @property
    def descriptors(self) -> Floats32:
        """Unit RootSIFT descriptors (n, 128)."""
        return root_sift(self.sift)


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class LandmarkConsensus:
    """Matched landmarks (`clouds.landmarks`), 3-D to 3-D: scale is known, and a flat wall is no special case."""

    ratio: float = Field(
        default=0.85, gt=0, le=1, description="a match is this much nearer than the second; the consensus forgives more"
    )
    tolerance_m: float = Field(
        default=0.05, gt=0, description="metres between matched landmarks: the noise of depth at 4 m"
    )

    def describe(self, cloud: PointCloud) -> DescribedImage:
        """The landmarks of a frame."""
        landmarks = cloud.landmarks or Landmarks.none()
        return DescribedImage(np.array(landmarks.points_in_cam), np.array(landmarks.descriptors))

    def match(self, target: DescribedImage, source: DescribedImage) -> Match:
        """Where the source's camera lies in the target's."""
        rows = match(target.descriptors, source.descriptors, self.ratio)
        points = target.points_in_cam[rows[:, 0]].astype(float), source.points_in_cam[rows[:, 1]].astype(float)
        found = rigid_consensus(*points, self.tolerance_m)
        return Match(found.i_from_j, found.count, len(rows), found.rival_count)
