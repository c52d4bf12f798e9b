"""Points with normals from a depth image, as a grid of pixels gives them."""

from __future__ import annotations

import numpy as np

from hodge_pipeline.types import Bytes, Camera, Floats, Floats32, PointCloud

MAX_STEP = 0.05
"""Share of the depth: a larger step between neighbouring pixels is an edge of an object, which has no normal."""


def depth_points(
    depth_m: Floats32, colour: Bytes | None, camera: Camera, stride: int, min_depth_m: float, max_depth_m: float
) -> PointCloud:
    """One point for each `stride`-th pixel whose depth is within the bounds, in the camera's axes.

    A normal faces the camera; it is 0 where the pixel lies at an edge or beside a missing measurement.
    """
    z = depth_m[::stride, ::stride].astype(float)
    v, u = np.mgrid[0 : depth_m.shape[0] : stride, 0 : depth_m.shape[1] : stride]
    grid = np.stack([(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z], axis=-1)
    valid = (z >= max(min_depth_m, 1e-6)) & (z <= max_depth_m)
    return PointCloud(
        points_in_cam=grid[valid].astype(np.float32),
        normals_in_cam=_normals(grid)[valid].astype(np.float32),
        colours=None if colour is None else _at(colour, depth_m.shape, stride)[valid],
    )


def _at(colour: Bytes, depth_shape: tuple[int, ...], stride: int) -> Bytes:
    """The colours of the strided depth pixels; the images may differ in size, not in field of view."""
    rows = (2 * np.arange(0, depth_shape[0], stride) + 1) * colour.shape[0] // (2 * depth_shape[0])
    columns = (2 * np.arange(0, depth_shape[1], stride) + 1) * colour.shape[1] // (2 * depth_shape[1])
    return colour[np.ix_(rows, columns)]


def _normals(grid: Floats) -> Floats:
    """Unit normals (H, W, 3) by central differences; 0 at the border and at edges."""
    down, right = grid[2:, 1:-1] - grid[:-2, 1:-1], grid[1:-1, 2:] - grid[1:-1, :-2]
    z = grid[1:-1, 1:-1, 2]
    smooth = (np.abs(down[..., 2]) < 2 * MAX_STEP * z) & (np.abs(right[..., 2]) < 2 * MAX_STEP * z)
    normals = np.cross(down, right)
    length = np.linalg.norm(normals, axis=-1)
    away = np.einsum("hwk,hwk->hw", normals, grid[1:-1, 1:-1]) > 0
    out = np.zeros_like(grid)
    scale = np.where(away, -1.0, 1.0) / np.where(smooth & (length > 1e-12), length, np.inf)
    out[1:-1, 1:-1] = normals * scale[..., None]
    return out
