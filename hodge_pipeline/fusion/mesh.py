"""Triangle meshes with sorted vertices, and the join of meshes that meet."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hodge_pipeline.types import Bools, Bytes, Floats32


@dataclass(frozen=True)
class Mesh:
    """Vertices (V, 3), their normals and colours, and triangles (T, 3)."""

    points: Floats32
    normals: Floats32
    colours: Bytes
    triangles: NDArray[np.int32]

    def ordered(self) -> Mesh:
        """The same mesh, its vertices by x, y, z: the order in which a grid gives them changes from run to run."""
        order = np.lexsort(self.points.T[::-1])
        rank = np.empty(len(order), np.int32)
        rank[order] = np.arange(len(order), dtype=np.int32)
        return Mesh(
            self.points[order],
            self.normals[order],
            self.colours[order],
            _sorted_triangles(np.asarray(rank[self.triangles], np.int32)),
        )

    def with_triangles(self, chosen: Bools) -> Mesh:
        """The chosen triangles (T,) alone, with the vertices that they have."""
        used, corners = np.unique(self.triangles[chosen], return_inverse=True)
        triangles = np.asarray(corners.reshape(-1, 3), np.int32)
        return Mesh(self.points[used], self.normals[used], self.colours[used], triangles)

    @classmethod
    def joined(cls, parts: Sequence[Mesh]) -> Mesh:
        """Ordered parts that meet as one: where two have a vertex at the same place it becomes one."""
        points, normals = (
            np.concatenate([np.zeros((0, 3), np.float32), *(getattr(part, name) for part in parts)])
            for name in ("points", "normals")
        )
        colours = np.concatenate([np.zeros((0, 3), np.uint8), *(part.colours for part in parts)])
        own = np.repeat(np.arange(len(parts)), [len(part.points) for part in parts])
        order = np.lexsort((own, *points.T[::-1]))
        is_new = np.ones(len(order), bool)
        is_new[1:] = (points[order[1:]] != points[order[:-1]]).any(axis=1) | (own[order[1:]] == own[order[:-1]])
        rank = np.empty(len(order), np.int32)
        rank[order] = np.cumsum(is_new, dtype=np.int32) - 1
        starts = np.cumsum([0, *(len(part.points) for part in parts)])[:-1]
        corners = [
            np.asarray(rank[part.triangles + start], np.int32) for part, start in zip(parts, starts, strict=True)
        ]
        first = order[is_new]
        triangles = np.concatenate([np.zeros((0, 3), np.int32), *corners])
        return cls(points[first], normals[first], colours[first], _sorted_triangles(triangles))


def _sorted_triangles(triangles: NDArray[np.int32]) -> NDArray[np.int32]:
    """The same triangles, each turned to begin with its least vertex, in ascending order."""
    turns = (np.argmin(triangles, axis=1)[:, None] + np.arange(3)) % 3
    turned = np.take_along_axis(triangles, turns, axis=1)
    return turned[np.lexsort(turned.T[::-1])]
