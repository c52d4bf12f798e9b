"""LAS and E57 files of a small room, for the tests of their readers."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from hodge_pipeline import se3

ROOM = np.random.default_rng(0).uniform(0, 3, (50, 3))
FAR = np.array([431_000.0, 5_401_000.0, 120.0])
"""Where a map's coordinates are: float32 would round them to half a metre."""


def write_las(path: Path, points: np.ndarray, bits: int = 16, times_s: float | np.ndarray = 0.0) -> Path:
    laspy = pytest.importorskip("laspy", reason="laspy is not installed: pip install 'hodge-pipeline[scans]'")
    header = laspy.LasHeader(point_format=3, version="1.2")
    header.scales, header.offsets = np.full(3, 1e-4), points.min(axis=0, initial=FAR.max())
    las = laspy.LasData(header)
    las.x, las.y, las.z = points.T
    las.red = las.green = np.full(len(points), 200 * (257 if bits == 16 else 1))
    las.blue, las.gps_time = np.zeros(len(points)), np.zeros(len(points)) + times_s
    las.write(str(path))
    return path


def write_e57(path: Path, poses: np.ndarray, scans: Sequence[np.ndarray] | None = None) -> Path:
    """One scan at each pose; `scans` are points in the axes of each, without them all see the room."""
    pye57 = pytest.importorskip("pye57", reason="pye57 is not installed: pip install 'hodge-pipeline[scans]'")
    file = pye57.E57(str(path), mode="w")
    for row, pose in enumerate(poses):
        local = se3.transform(se3.inverse(pose), ROOM) if scans is None else scans[row]
        columns = {f"cartesian{axis}": local[:, at].copy() for at, axis in enumerate("XYZ")}
        columns.update({f"color{name}": np.full(len(local), 7, np.uint8) for name in ("Red", "Green", "Blue")})
        quat_wxyz = se3.to_quat_xyzw(pose)[[3, 0, 1, 2]]
        file.write_scan_raw(columns, rotation=quat_wxyz, translation=pose[:3, 3].copy())
    file.close()
    return path
