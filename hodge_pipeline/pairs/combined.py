"""Several edge builders as one, within a budget."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
from pydantic import Field
from pydantic.dataclasses import dataclass

from hodge_pipeline.pairs.candidates import has_reason, merge
from hodge_pipeline.pairs.sequential import SequentialEdges
from hodge_pipeline.stages import OPTIONS, EdgeBuilder
from hodge_pipeline.types import Bools, CloudSet, Edges, Floats, Frame, Ints


@dataclass(frozen=True, config=OPTIONS)
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


def spread(candidates: Edges, frame_count: int, max_edges_per_frame: float, always: Bools) -> Edges:
    """At most `max_edges_per_frame · frame_count` of the candidates (P,), but all that `always` (P,) marks.

    A pair next to one already taken, such as (11, 200) beside (10, 200), closes a loop that is closed. So the (i, j)
    plane is thinned like a picture: first one pair from each coarse cell, then from each finer one.
    Each frame's best pair of every loop length (an octave of j − i) comes before any second-best, so that no frame is
    left with its neighbours alone; best is what comes first in `thinning_order`. The same input gives the same pairs.
    """
    room = int(max_edges_per_frame * frame_count) - int(always.sum())
    optional = np.flatnonzero(~always)
    if len(optional) <= room:
        return candidates
    pairs = candidates.pairs[optional]
    order = thinning_order(pairs, np.nan_to_num(candidates.overlap[optional], nan=0.0))
    turn = first_turn(pairs[order])
    taken = optional[order[np.argsort(turn, kind="stable")[: max(0, room)]]]
    return candidates.select(np.sort(np.concatenate([np.flatnonzero(always), taken])))


def thinning_order(pairs: Ints, scores: Floats) -> Ints:
    """Rows of the pairs (P, 2), coarse to fine.

    At each level the (i, j) plane is cut into square cells whose side halves from level to level; the pair of the
    best score in a cell stands for it, and belongs to the coarsest level at which it stands for one. Within a level
    the better score goes first.
    """
    best_first = np.lexsort((pairs[:, 1], pairs[:, 0], -scores))
    coarseness = np.zeros(len(pairs), np.int64)
    standing, side = best_first, 2
    while len(standing) > 1 and side <= 2 * int(pairs.max(initial=0)):
        # The best of a cell is the best of the smaller cell it came from: only those that stood need be looked at.
        cells = pairs[standing] // side
        _, first = np.unique(cells[:, 0] << 32 | cells[:, 1], return_index=True)
        standing = standing[np.sort(first)]
        coarseness[standing] += 1
        side *= 2
    return np.asarray(best_first[np.argsort(-coarseness[best_first], kind="stable")])


def first_turn(pairs: Ints) -> Ints:
    """For each pair (P, 2) its place, 0 first, among those of its own loop length that share a frame with it: of the
    places in the lists of its two frames, the earlier one.
    """
    octave = np.frexp((pairs[:, 1] - pairs[:, 0]).astype(float))[1].astype(np.int64)
    lists = (pairs * 64 + octave[:, None]).ravel()
    by_list = np.argsort(lists, kind="stable")
    _, starts, sizes = np.unique(lists[by_list], return_index=True, return_counts=True)
    place = np.empty(len(lists), np.int64)
    place[by_list] = np.arange(len(lists)) - np.repeat(starts, sizes)
    return np.asarray(place.reshape(-1, 2).min(axis=1))
