"""Clouds, scans and logs of poses, for the tests of their readers."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hodge_adapters.clouds.ply import write_ply
from hodge_pipeline.types import PointCloud
from hodge_pipeline.types import ply as ply


def cloud(count: int = 20, seed: int = 0) -> PointCloud:
    rng = np.random.default_rng(seed)
    normals = rng.normal(0, 1, (count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    colours = rng.integers(0, 256, (count, 3)).astype(np.uint8)
    return PointCloud(rng.normal(0, 1, (count, 3)).astype(np.float32), normals.astype(np.float32), colours)


def fragments(folder: Path, count: int = 3) -> Path:
    folder.mkdir()
    for number in range(count):
        write_ply(folder / f"cloud_bin_{number * 5}.ply", cloud(seed=number))
    return folder


def log_block(i: int, j: int, pose: np.ndarray) -> str:
    return f"{i} {j} 3\n" + "\n".join(" ".join(map(repr, row)) for row in pose.tolist()) + "\n"


def lidar_scan(count: int = 48, seed: int = 0) -> np.ndarray:
    """Points (count, 3) round a scanner, in the order in which it turns."""
    angle = np.linspace(0, 2 * np.pi, count, endpoint=False)
    radius = 10 + np.random.default_rng(seed).uniform(0, 0.1, count)
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), np.full(count, -1.7)]).astype("<f4")
