"""Several edge builders as one, within a budget."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from hodge_pipeline.pairs.budget import spread
from hodge_pipeline.pairs.candidates import has_reason, merge
from hodge_pipeline.pairs.sequential import SequentialEdges
from hodge_pipeline.stages import EdgeBuilder
from hodge_pipeline.types import CloudSet, Edges, Floats, Frame


@dataclass(frozen=True, config=ConfigDict(extra="forbid", arbitrary_types_allowed=True))
class CombinedEdges:
    """Unites or intersects the pairs of several builders; sequential pairs always stay."""

    builders: tuple[EdgeBuilder, ...] = Field(
        min_length=1, description="the edge builders; their order is that of the reasons in a pair's source"
    )
    mode: Literal["any", "all"] = Field(
        "any",
        description="any: a pair that one builder proposes; all: a pair that every builder but `sequential` proposes. "
        "Pairs for the reason sequential stay in both, so that the graph is connected where the sequence is",
    )
    max_edges_per_frame: float | None = Field(
        None,
        gt=0,
        description="edges divided by frames, at most: the sequential ones stay whatever their number, and fill it "
        "first, the others are spread over loops of every length (9 serves a room of 250 frames); null keeps all",
    )

    def propose(self, frames: Sequence[Frame], clouds: CloudSet, world_from_cam: Floats) -> Edges:
        """Pairs with their reasons joined by "+", as `sequential+overlap`, and the best overlap that a builder gave."""
        merged, votes = merge([builder.propose(frames, clouds, world_from_cam) for builder in self.builders])
        always = has_reason(merged, "sequential")
        if self.mode == "all":
            voters = [k for k, builder in enumerate(self.builders) if not isinstance(builder, SequentialEdges)]
            agreed = votes[:, voters].all(axis=1) if voters else np.zeros(len(votes), bool)
            rows = np.flatnonzero(always | agreed)
            merged, always = merged.select(rows), always[rows]
        if self.max_edges_per_frame is None:
            return merged
        return spread(merged, len(frames), self.max_edges_per_frame, always)
