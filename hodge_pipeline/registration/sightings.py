"""Where frames saw the corners of their key frames: what every frame is posed by once the key frames are solved."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from hodge_pipeline.registration.flow import Followed
from hodge_pipeline.types import Floats, Ints


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
        """The columns of what was found at (key frame's place, frame's place) in a block of these rows; `points (n, 3)`
        are the corners of the key frame at a place.
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
