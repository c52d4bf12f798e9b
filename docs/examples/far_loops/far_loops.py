"""An edge builder that closes loops only: frames near in space that are far apart in the sequence."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from hodge_pipeline.types import CloudSet, Edges, Floats, Frame


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class FarLoops:
    """Pairs each frame with the nearest ones that lie at least `gap` frames away."""

    gap: int = Field(20, ge=1, description="frames: what is nearer in the sequence is no loop; 20 is under a second")
    loops_per_frame: int = Field(2, ge=1, description="pairs proposed for each frame; two survive one bad registration")
    max_distance_m: float = Field(1.0, gt=0, description="metres between the cameras; beyond it a room looks different")

    def propose(self, frames: Sequence[Frame], clouds: CloudSet, world_from_cam: Floats) -> Edges:
        """The pairs, given the poses (N, 4, 4) so far; a frame without points gets none."""
        centres, rows = world_from_cam[:, :3, 3], np.arange(len(frames))
        distance_m = np.linalg.norm(centres[:, None] - centres[None], axis=2)
        distance_m[np.abs(rows[:, None] - rows[None]) < self.gap] = np.inf
        empty = clouds.sizes == 0
        distance_m[empty], distance_m[:, empty] = np.inf, np.inf
        nearest = np.argsort(distance_m, axis=1, kind="stable")[:, : self.loops_per_frame]
        near = np.take_along_axis(distance_m, nearest, axis=1) <= self.max_distance_m
        pairs = np.stack([np.broadcast_to(rows[:, None], nearest.shape)[near], nearest[near]], axis=1)
        return Edges.proposed(np.unique(np.sort(pairs, axis=1), axis=0), "far loop")
