"""Scans of 3DTK (`uos`): points in `scanNNN.3d`, poses in `scanNNN.pose`, in centimetres of a left-handed frame."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from hodge_adapters.clouds.columns import points_of_parts
from hodge_adapters.clouds.tables import fields_of, is_row, row_parts
from hodge_adapters.text_rows import first_text, read_rows, to_floats
from hodge_pipeline import se3
from hodge_pipeline.errors import SourceError
from hodge_pipeline.types import Floats, PointCloud

ENDING, POSE = ".3d", ".pose"
UNITS_PER_METRE = 100.0
MOST_DEGREES = 1e6
"""Angles beyond are damage, and have no turn left in double precision."""
AHEAD_LEFT_UP = np.array([[0.0, 0, 1], [-1, 0, 0], [0, 1, 0]])
"""Of 3DTK's x to the right, y up, z ahead: the inverse of what its reader of `xyz` does."""


def read_uos(path: Path) -> PointCloud:
    """The points in metres, x ahead, y left, z up: the first three numbers of each row (reflectances, colours and
    normals, which nothing tells apart, are left). A first line that is no row of numbers is a header.
    """
    rows = [line for line in first_text(path).splitlines() if is_row(line.encode())]
    first, second = (*rows[:2], "", "")[:2]
    header = len(to_floats(fields_of(first)) or ()) < 3
    width = len(fields_of(second if header else first))
    if width < 3:
        raise SourceError(f"{path}: holds no rows of x, y and z: give a scan of 3DTK")
    cloud = points_of_parts(path, row_parts(path, [*"xyz", *map(str, range(3, width))], int(header)))
    points = cloud.points_in_cam @ (AHEAD_LEFT_UP.T / UNITS_PER_METRE).astype(np.float32)
    return replace(cloud, points_in_cam=points)


def pose_file(scan: Path) -> Path | None:
    """The `.pose` beside a scan of 3DTK, None where there is none."""
    path = scan.with_suffix(POSE)
    return path if scan.suffix.lower() == ENDING and path.is_file() else None


def uos_pose(scan: Path) -> Floats | None:
    """`world_from_scan` (4, 4) in metres from the `.pose` beside a scan of 3DTK: x y z in centimetres, then the angles
    about x, y and z in degrees. None where there is none; raises `SourceError` where it holds something else.
    """
    path = pose_file(scan)
    if path is None:
        return None
    values = to_floats([field for row in read_rows(path) for field in row.fields]) or []
    if len(values) != 6 or not (np.abs(values) < se3.MAX_NUMBER).all() or max(map(abs, values[3:])) > MOST_DEGREES:
        raise SourceError(f"{path}: holds no six numbers (x y z in cm, angles in degrees): restore or remove it")
    turns = se3.so3_exp(np.diag(np.radians(values[3:])))
    turn = AHEAD_LEFT_UP @ turns[0] @ turns[1] @ turns[2] @ AHEAD_LEFT_UP.T
    return se3.from_parts(turn, AHEAD_LEFT_UP @ values[:3] / UNITS_PER_METRE)
