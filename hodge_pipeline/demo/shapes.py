"""Triangle meshes of simple bodies. Each stands on z = 0, centred on the z axis; metres."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.types import Floats, Ints


@dataclass(frozen=True)
class Mesh:
    """Vertices (V, 3), their unit normals (V, 3) and triangles (T, 3) of rows; sharp edges have two vertices."""

    vertices: Floats
    normals: Floats
    triangles: Ints

    def moved(self, b_from_a: Floats) -> Mesh:
        """The mesh in frame b."""
        rotated = self.normals @ b_from_a[:3, :3].T
        return Mesh(se3.transform(b_from_a, self.vertices), rotated, self.triangles)


def _grid(rows: int, columns: int) -> Ints:
    """Triangles (T, 3) of a rows x columns grid of vertices, numbered along its rows."""
    corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    lower = np.stack([corner, corner + 1, corner + columns], axis=1)
    upper = np.stack([corner + 1, corner + columns + 1, corner + columns], axis=1)
    return np.concatenate([lower, upper]).astype(np.int64)


def box(width: float, depth: float, height: float) -> Mesh:
    """A box: width along x, depth along y, height along z."""
    vertices: list[Floats] = []
    normals: list[Floats] = []
    triangles: list[Ints] = []
    quad = np.array([[-1, -1], [1, -1], [-1, 1], [1, 1]]) / 2
    for axis in range(3):
        for side in (-0.5, 0.5):
            face = np.insert(quad, axis, side, axis=1)
            triangles.append(_grid(2, 2) + 4 * len(vertices))
            vertices.append((face + np.array([0, 0, 0.5])) * np.array([width, depth, height]))
            normals.append(np.tile(np.sign(side) * np.eye(3)[axis], (4, 1)))
    return Mesh(np.concatenate(vertices), np.concatenate(normals), np.concatenate(triangles))


def lathe(profile: Sequence[tuple[float, float]], sides: int = 24) -> Mesh:
    """The surface of revolution about the z axis of a profile of (radius, z), from bottom to top.

    Each piece of the profile is smooth round the axis; the normals of neighbouring pieces are averaged where they
    differ by less than 45 degrees.
    """
    points = np.asarray(profile, float)
    steps = np.diff(points, axis=0)
    outward = np.stack([steps[:, 1], -steps[:, 0]], axis=1) / np.linalg.norm(steps, axis=1, keepdims=True)
    bends = np.einsum("ij,ij->i", outward[:-1], outward[1:]) > np.cos(np.pi / 4)
    start, end = outward.copy(), outward.copy()
    mean = (outward[:-1] + outward[1:]) / np.linalg.norm(outward[:-1] + outward[1:] + 1e-12, axis=1, keepdims=True)
    end[:-1][bends] = start[1:][bends] = mean[bends]
    rings = np.stack([points[:-1], points[1:]], axis=1).reshape(-1, 2)
    ring_normals = np.stack([start, end], axis=1).reshape(-1, 2)
    angle = np.linspace(0, 2 * np.pi, sides + 1)
    round_axis = np.stack([np.cos(angle), np.sin(angle)], axis=1)

    def swept(pairs: Floats) -> Floats:
        flat = pairs[:, None, :1] * round_axis[None]
        return np.concatenate([flat, np.broadcast_to(pairs[:, None, 1:], (*flat.shape[:2], 1))], axis=2).reshape(-1, 3)

    pieces = [_grid(2, sides + 1) + 2 * k * (sides + 1) for k in range(len(steps))]
    return Mesh(swept(rings), swept(ring_normals), np.concatenate(pieces))


def cylinder(radius: float, height: float, sides: int = 24) -> Mesh:
    """A closed cylinder about the z axis."""
    return lathe([(0, 0), (radius, 0), (radius, height), (0, height)], sides)


def ball(radius: float, sides: int = 24) -> Mesh:
    """A sphere that rests on z = 0."""
    angle = np.linspace(-np.pi / 2, np.pi / 2, sides // 2 + 1)
    return lathe([(float(radius * np.cos(a)), float(radius * (1 + np.sin(a)))) for a in angle], sides)


def curtain(width: float, height: float, folds: int, depth: float) -> Mesh:
    """A hanging sheet in the x-z plane whose folds reach `depth` along y."""
    along = np.linspace(0, 1, 12 * folds + 1)
    phase = 2 * np.pi * folds * along
    line = np.stack([width * (along - 0.5), depth / 2 * np.sin(phase)], axis=1)
    slope = np.stack([np.full(len(along), width), depth * np.pi * folds * np.cos(phase)], axis=1)
    normal = np.stack([slope[:, 1], -slope[:, 0]], axis=1) / np.linalg.norm(slope, axis=1, keepdims=True)
    levels = [np.column_stack([line, np.full(len(line), z)]) for z in (0.0, height)]
    normals = np.column_stack([normal, np.zeros(len(normal))])
    return Mesh(np.concatenate(levels), np.concatenate([normals, normals]), _grid(2, len(line)))
