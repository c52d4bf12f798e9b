"""The poses of a run, round by round."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from hodge_pipeline.types import Edges, Floats, Ints, Solution, Source, ViewGraph
from hodge_pipeline.types.edges import REJECTED


@dataclass(frozen=True)
class Round:
    """One outer iteration: every pair that it knows of, and the poses (N, 4, 4) that its edges led to. Round 0 holds
    the first poses, which `name` tells: odometry, or start where they were given.

    The pairs that a round registered come first in `edges`, then those that came measured. A round is `edited` where a
    person's edits made it.
    """

    edges: Edges
    vertex_ids: NDArray[np.generic]
    world_from_cam: Floats
    solution: Solution | None = None
    edited: bool = False
    name: str = "odometry"

    @cached_property
    def graph_edges(self) -> Edges:
        """The rows that are edges, in the order of `graph`: those that count, and those that are off by hand."""
        return self.edges.select(self.edges.in_graph)

    @cached_property
    def graph(self) -> ViewGraph:
        """The viewing graph."""
        return self.graph_edges.as_graph(self.vertex_ids)

    @property
    def rejected(self) -> Edges:
        """The pairs that were registered and are no edges."""
        return self.edges.select(self.edges.status == REJECTED)

    def registered(self, measured: ViewGraph) -> Edges:
        """The rows without those that came measured."""
        return self.edges.select(slice(len(self.edges) - measured.edge_count))


def pose_sets(rounds: Sequence[Round]) -> dict[str, Floats]:
    """The poses by name: odometry (or start), round 1, …, result."""
    names = [rounds[0].name, *(f"round {number}" for number in range(1, len(rounds) - 1)), "result"]
    return {name: one.world_from_cam for name, one in zip(names, rounds, strict=True)}


def true_poses(source: Source) -> Floats:
    """The source's own poses (N, 4, 4), NaN where a frame has none."""
    poses = np.full((len(source.frames), 4, 4), np.nan)
    for row, frame in enumerate(source.frames):
        if frame.world_from_cam is not None:
            poses[row] = frame.world_from_cam
    return poses


def has_truth(source: Source) -> bool:
    """Whether there are at least two poses of the source's own to compare with."""
    return sum(frame.world_from_cam is not None for frame in source.frames) > 1


def sequences_of(source: Source) -> dict[str, Ints]:
    """The rows of each sequence, in the order of the source."""
    names = np.array([frame.sequence for frame in source.frames])
    return {str(name): np.flatnonzero(names == name) for name in dict.fromkeys(names.tolist())}
