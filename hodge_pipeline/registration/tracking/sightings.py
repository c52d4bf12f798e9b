"""Where frames saw the corners of their key frames, for resecting every frame once the key frames are solved."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hodge_pipeline.registration.tracking.flow import Followed
from hodge_pipeline.store import artifacts
from hodge_pipeline.types import Floats, Ints
from hodge_pipeline.types.arrays import evenly, groups

MOST_BLOCKS = 10
"""Files that `views` reads, evenly spread."""
FEWEST_CORNERS = 60
"""Corners that a view needs."""


@dataclass(frozen=True)
class Sightings:
    """Where frames saw the corners of their key frames.

    `key (C,)` is the row of the key frame of each corner, `points (C, 3)` the corner in its camera's axes; `frame (S,)`
    is the row of each sighting's frame, `corner (S,)` which of the C it saw, `seen (S, 3)` the columns u, v, z, z NaN
    where there was no depth.
    """

    key: Ints
    points: Floats
    frame: Ints
    corner: Ints
    seen: Floats

    @classmethod
    def of(cls, found: Mapping[tuple[int, int], Followed], points: Mapping[int, Floats], rows: Ints) -> Sightings:
        """The sightings `found` at (key frame's place, frame's place) in a block of these rows; `points (n, 3)` are the
        corners of the key frame at a place.
        """
        pairs = sorted(found)
        keys = sorted({key for key, _ in pairs})
        counts = [len(points[key]) for key in keys]
        first = dict(zip(keys, np.cumsum([0, *counts])[:-1].tolist(), strict=True))
        sizes = [len(found[pair].rows) for pair in pairs]
        no_rows = np.zeros(0, np.int64)
        return cls(
            key=np.repeat(rows[np.array(keys, np.int64)], counts),
            points=np.concatenate([np.zeros((0, 3)), *(points[key] for key in keys)]),
            frame=np.repeat(rows[np.array([view for _, view in pairs], np.int64)], sizes),
            corner=np.concatenate([no_rows, *(first[pair[0]] + found[pair].rows for pair in pairs)]),
            seen=np.concatenate([np.zeros((0, 3)), *(found[pair].seen for pair in pairs)]),
        )


@dataclass(frozen=True)
class View:
    """What a frame saw of its key frame: `points (n, 3)` in the key frame's axes, `seen (n, 3)` columns u, v, z."""

    key: int
    row: int
    points: Floats
    seen: Floats


def views(sightings: Path) -> Iterator[View]:
    """The views of a folder of `Sightings`, of some of its blocks."""
    paths = sorted(sightings.glob("*.npz"))
    for at in evenly(len(paths), MOST_BLOCKS):
        block = artifacts.load(paths[at], Sightings)
        for row, own in groups(block.frame):
            for key, part in groups(block.key[block.corner[own]]):
                if key != row and len(part) >= FEWEST_CORNERS:
                    yield View(key, row, block.points[block.corner[own[part]]], block.seen[own[part]])
