"""Initial viewpoint of the 3-D views: above and behind the cameras, or scanners."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from rerun.chunk import Chunk

from hodge_pipeline import se3
from hodge_pipeline.types import Floats
from hodge_pipeline.types.axes import up_and_ahead

ELEVATION = 0.6
DISTANCE = 0.8
"""In units of the scene's size, along the mean view and above it."""
MAX_POINTS = 20_000
"""Points by which the size of a scene is measured, spread over all: its quantiles need no more."""


@dataclass(frozen=True)
class Eye:
    """Position, target and up direction, each (3,), in the world."""

    position: tuple[float, float, float]
    target: tuple[float, float, float]
    up: tuple[float, float, float]

    def from_afar(self, times: float) -> Eye:
        """The eye moved back along its view, to so many times its distance: for a view that is narrow."""
        position, target = np.array(self.position), np.array(self.target)
        return Eye(_triple(target + times * (position - target)), self.target, self.up)


@dataclass(frozen=True)
class Eyes:
    """Viewpoints of the model, of the graph without it, and of the clouds of a pair in the axes of the first."""

    room: Eye | None
    graph: Eye | None
    pair: Eye | None


def look_at(model_chunks: Iterable[Chunk], pose_chunks: Iterable[Chunk], is_scanner: bool = False) -> Eye | None:
    """An eye that has the model in view, or the sensors where there is no model; None where there are no poses."""
    return look_from(_poses(pose_chunks), points_of(model_chunks), is_scanner)


def look_from(poses: Floats, points: Floats, is_scanner: bool) -> Eye | None:
    """As `look_at`, of the poses (N, 4, 4) and the points (P, 3) themselves."""
    if not len(poses):
        return None
    scene = points if len(points) else poses[:, :3, 3]
    low, high = np.percentile(scene, [3, 97], axis=0)
    size = max(float(np.linalg.norm(high - low)), 0.5)
    up, ahead = up_and_ahead(poses, is_scanner)
    target = (low + high) / 2
    position = target - DISTANCE * size * (ahead - ELEVATION * up)
    return Eye(_triple(position), _triple(target), _triple(up))


def _triple(vector: Floats) -> tuple[float, float, float]:
    return float(vector[0]), float(vector[1]), float(vector[2])


def _column(chunk: Chunk, name: str, width: int) -> Floats:
    batch = chunk.to_record_batch()
    if name not in batch.schema.names:
        return np.zeros((0, width))
    values = batch.column(name).flatten()
    return np.asarray(values.flatten().to_numpy(zero_copy_only=False), float).reshape(-1, width)


def points_of(chunks: Iterable[Chunk]) -> Floats:
    """Some of the points and vertices (P, 3) in these chunks."""
    names = ("Mesh3D:vertex_positions", "Points3D:positions")
    found = [_column(chunk, name, 3) for chunk in chunks for name in names]
    points = np.concatenate([np.zeros((0, 3)), *found])
    return points[:: max(len(points) // MAX_POINTS, 1)]


def _poses(chunks: Iterable[Chunk]) -> Floats:
    parts = [(_column(c, "Transform3D:quaternion", 4), _column(c, "Transform3D:translation", 3)) for c in chunks]
    poses = [se3.from_quat_xyzw(t, q) for q, t in parts if len(q) and len(q) == len(t)]
    return np.concatenate([np.zeros((0, 4, 4)), *poses])
