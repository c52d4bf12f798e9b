"""Choose key frames by how far the camera has moved since the last one."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.types import Floats, Ints


def choose_key_frames(
    world_from_cam: Floats, sequences: Sequence[Ints], distance_m: float, angle_deg: float, every: int
) -> Ints:
    """Rows of the key frames, ascending: first and last of each sequence, every n-th, and wherever it moved."""
    chosen: list[int] = []
    for rows in sequences:
        last = int(rows[0])
        chosen.append(last)
        for place, row in enumerate(map(int, rows[1:]), start=1):
            step = se3.inverse(world_from_cam[last]) @ world_from_cam[row]
            turned_deg = np.rad2deg(se3.rotation_angle(step))
            moved = np.linalg.norm(step[:3, 3]) >= distance_m or turned_deg >= angle_deg
            if moved or (every and place % every == 0):
                chosen.append(row)
                last = row
        if chosen[-1] != int(rows[-1]):
            chosen.append(int(rows[-1]))
    return np.array(sorted(chosen), np.int64)
