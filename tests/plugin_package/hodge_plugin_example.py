"""A third party's edge builder: each frame with the next, and the last with the first."""

from collections.abc import Sequence

import numpy as np
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from hodge_pipeline.types import CloudSet, Edges, Floats, Frame


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class RingEdges:
    """Pairs each frame with the one `reach` after it, round the ring."""

    reach: int = Field(1, ge=1, description="frames from one end of a pair to the other")

    def propose(self, frames: Sequence[Frame], clouds: CloudSet, world_from_cam: Floats) -> Edges:
        """The pairs of the ring; frames without points get none."""
        rows = np.flatnonzero(clouds.sizes)
        pairs = np.stack([rows, np.roll(rows, -self.reach)], axis=1)
        pairs = np.unique(np.sort(pairs[pairs[:, 0] != pairs[:, 1]], axis=1), axis=0)
        return Edges.proposed(pairs, "ring")
