"""An order for frames that have none: a walk from each to the nearest that is left.

Edge builders that know an order (the frames before and after, loops of every length) work along it as along a video.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from hodge_pipeline.stages import EdgeBuilder
from hodge_pipeline.types import CloudSet, Edges, Floats, Frame, Ints

METRES_A_RADIAN = 1.0
"""How far a camera may move for what it loses from view when it turns by a radian, in a room."""


def tour(world_from_cam: Floats, scale: float = 1.0) -> Ints:
    """The rows (N,) of poses (N, 4, 4) in the order of a greedy walk: near in place and in direction.

    `scale` multiplies lengths that are for rooms.
    """
    count = len(world_from_cam)
    turn = np.sqrt(2.0) / 2 * METRES_A_RADIAN * scale  # |R − R'| is √2 times the angle, for small ones
    flat = np.concatenate([world_from_cam[:, :3, 3], turn * world_from_cam[:, :3, :3].reshape(count, 9)], axis=1)
    left = np.ones(count, bool)
    order = np.zeros(count, np.int64)
    for at in range(1, count):
        left[order[at - 1]] = False
        squared = ((flat - flat[order[at - 1]]) ** 2).sum(axis=1)
        order[at] = int(np.where(left, squared, np.inf).argmin())
    return order


def propose_along_tour(
    edges: EdgeBuilder, frames: Sequence[Frame], clouds: CloudSet, world_from_cam: Floats, scale: float = 1.0
) -> Edges:
    """What the builder proposes for the frames in the order of their tour; `sequential` pairs are called nearest."""
    order = tour(world_from_cam, scale)
    found = edges.propose(
        [frames[row] for row in order], CloudSet.from_clouds([clouds[row] for row in order]), world_from_cam[order]
    )
    if not len(found):  # a single scan; np.char.replace wants one word at least
        return found
    pairs = order[found.pairs]
    back = Edges.proposed(pairs, "", found.overlap)
    low, high = np.sort(pairs, axis=1).T
    names = np.char.replace(found.proposed_by[np.lexsort((high, low))], "sequential", "nearest")
    return replace(back, proposed_by=names)
