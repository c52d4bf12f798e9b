"""Which way sensors look: the axes of cameras and of scanners, and whether clouds are a scanner's."""

from __future__ import annotations

import numpy as np

from hodge_pipeline.types.arrays import Floats, Ints, evenly
from hodge_pipeline.types.clouds import CloudSet

SCANNER_AXES = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])
"""Right, down and ahead of a scanner, or a robot, in its own axes: x ahead and z up; a camera's are the unit matrix."""
LOOKED_AT = 9
"""Clouds tested by `is_scanner`: all are of one sensor."""
SEEN_BEHIND = 0.01
"""Share of points with z < 0, which no camera has, above which the clouds are a scanner's: with z up, it is the ground.
"""


def is_scanner(clouds: CloudSet, rows: Ints | None = None) -> bool:
    """Whether the clouds of these rows, by a few of them, are a scanner's: with points at z < 0."""
    rows = np.flatnonzero(clouds.sizes > 0) if rows is None else rows
    looked_at = rows[evenly(len(rows), LOOKED_AT)].tolist()
    return len(rows) > 0 and bool(
        np.mean([(clouds[row].points_in_cam[:, 2] < 0).mean() for row in looked_at]) > SEEN_BEHIND
    )


def up_and_ahead(world_from_cam: Floats, is_scanner: bool) -> tuple[Floats, Floats]:
    """Unit vectors (3,): the mean up direction of cameras, or scanners, and their mean view direction across it."""
    axes = SCANNER_AXES if is_scanner else np.eye(3)
    _, down, ahead = axes @ world_from_cam[:, :3, :3].mean(axis=0).T
    up = unit(-down, -axes[1])
    return up, unit(ahead - (ahead @ up) * up, unit(np.cross(up, [1.0, 0.3, 0.2]), up))


def unit(vector: Floats, fallback: Floats) -> Floats:
    """The vector (3,) at length 1; the fallback where it has hardly any length."""
    length = float(np.linalg.norm(vector))
    return vector / length if length > 1e-3 else fallback
