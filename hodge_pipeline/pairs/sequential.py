"""Pairs of frames that follow each other in time: they keep the graph connected."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from hodge_pipeline.pairs.candidates import NO_PAIRS, usable_rows
from hodge_pipeline.types import CloudSet, Edges, Floats, Frame


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class SequentialEdges:
    """Pairs each frame with those that follow it in its own sequence."""

    reach: int = Field(
        1,
        ge=1,
        description="frames: the longest step between two frames of a pair, counted without the frames that have no "
        "points; 1 gives the chain alone",
    )

    def propose(self, frames: Sequence[Frame], clouds: CloudSet, world_from_cam: Floats) -> Edges:
        """Pairs at most `reach` apart among the frames of one sequence that have points: empty frames are bridged."""
        rows = usable_rows(clouds)
        names = np.array([frames[row].sequence for row in rows], dtype=np.str_)
        chains = [rows[names == name] for name in np.unique(names)]
        steps = [
            (chain[:-step], chain[step:]) for chain in chains for step in range(1, min(self.reach, len(chain)) + 1)
        ]
        pairs = [np.stack(step, axis=1) for step in steps]
        return Edges.proposed(np.concatenate([NO_PAIRS, *pairs]), "sequential")
