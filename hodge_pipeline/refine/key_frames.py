"""Key frames: those that are registered, chosen by how far the camera moved."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from hodge_pipeline import se3
from hodge_pipeline.types import Floats, Ints


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class KeyFrameOptions:
    """Which frames are registered where a run starts from given poses, or is long; the others move as those around
    them.
    """

    whole_up_to: int = Field(
        default=300,
        ge=1,
        description="frames: without given poses a source of so many is registered whole; a longer one is tracked from "
        "key frame to key frame, which are chosen by how far the camera moved and by what it still sees",
    )

    distance_m: float = Field(
        default=0.1,
        ge=0,
        description="metres from the last key frame at which a frame becomes one; 0: every frame. At 0.1 the pose "
        "between two key frames is known from its own tracking to a few millimetres",
    )
    angle_deg: float = Field(default=8.0, ge=0, description="degrees, likewise")
    every: int = Field(
        default=5,
        ge=0,
        description="frames: of given poses every such frame of a sequence is one, however little it moved, since they "
        "can jump where their maker joined two pieces; 0: none for that reason",
    )


def choose_key_frames(world_from_cam: Floats, sequences: Sequence[Ints], options: KeyFrameOptions) -> Ints:
    """Rows of the key frames, ascending: first and last of each sequence, every n-th, and wherever it moved."""
    chosen: list[int] = []
    for rows in sequences:
        last = int(rows[0])
        chosen.append(last)
        for place, row in enumerate(map(int, rows[1:]), start=1):
            step = se3.inverse(world_from_cam[last]) @ world_from_cam[row]
            angle_deg = np.rad2deg(np.linalg.norm(se3.so3_log(step[:3, :3])))
            moved = np.linalg.norm(step[:3, 3]) >= options.distance_m or angle_deg >= options.angle_deg
            if moved or (options.every and place % options.every == 0):
                chosen.append(row)
                last = row
        if chosen[-1] != int(rows[-1]):
            chosen.append(int(rows[-1]))
    return np.array(sorted(chosen), np.int64)
