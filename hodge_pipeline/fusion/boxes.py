"""A scene cut into boxes of voxel blocks that fit into memory."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from hodge_pipeline.types import Bools, Floats, Ints


@dataclass(frozen=True)
class Box:
    """The blocks from `low (3,)` on, below `high (3,)`."""

    low: Ints
    high: Ints

    @property
    def around(self) -> Box:
        """The box with one more block at each face."""
        return Box(self.low - 1, self.high + 1)

    def holds(self, blocks: Ints | Floats) -> Bools:
        """Whether each block (M, 3) is inside."""
        return np.asarray(((blocks >= self.low) & (blocks < self.high)).all(axis=1))

    def meets(self, others: Ints) -> Bools:
        """Whether each other box (M, 2, 3), its least and its largest block, has a block inside."""
        return np.asarray(((others[:, 1] >= self.low) & (others[:, 0] < self.high)).all(axis=1))


def boxes_of(blocks: Ints, most: int) -> Iterator[Box]:
    """Boxes that hold each of the blocks (M, 3) once, with at most `most` in and next to each that can still be cut."""
    if not len(blocks):
        return
    low, high = blocks.min(axis=0), blocks.max(axis=0) + 1
    yield from _cut(blocks, Box(low, high), most)


def _cut(blocks: Ints, box: Box, most: int) -> Iterator[Box]:
    own = blocks[box.around.holds(blocks)]
    axis = int(np.argmax(box.high - box.low))
    if len(own) <= most or box.high[axis] - box.low[axis] <= 1:
        yield box
        return
    inside = own[box.holds(own)][:, axis]
    middle = int(np.median(inside)) if len(inside) else int((box.low[axis] + box.high[axis]) // 2)
    at = min(max(middle, int(box.low[axis]) + 1), int(box.high[axis]) - 1)
    left, right = box.high.copy(), box.low.copy()
    left[axis] = right[axis] = at
    yield from _cut(own, Box(box.low, left), most)
    yield from _cut(own, Box(right, box.high), most)
