"""A pixel with its depth: as a point of the camera's axes, whether its depth is sound, and how far off both may be."""

from __future__ import annotations

import numpy as np

from hodge_pipeline.types import Bools, Camera, Floats, Floats32, Ints

PIXEL_SIGMA = 0.75
"""Pixels: the error of a corner that flow followed, once the shutter's is taken out, on TUM fr1."""
DEPTH_SIGMAS = 2.0
"""Factor on `depth_sigma`, the noise of one pixel on a plane: features and corners lie where depth is worst."""
EDGE_STEP = 0.03
"""Share of its depth by which the 3x3 pixels about one differ at most: others lie on an edge."""
BESIDE, NEARER = 7 / 640, 0.06
"""Share of the image's width, half the window of optical flow, within which nothing may be nearer than a feature by
this share of its depth: beside an occluder it follows that one's edge, and motions come out short. On two rendered
videos those of pairs of landmarks are 2.6 % short with such features, 1.4 % without.
"""


def depth_sigma(z_m: Floats) -> Floats:
    """Standard deviation in metres of a structured-light depth (Nguyen, Izadi and Lovell 2012, axial noise)."""
    return np.asarray(0.0012 + 0.0019 * (z_m - 0.4) ** 2)


def project(points_in_cam: Floats, camera: Camera) -> Floats:
    """Columns u, v, z (n, 3) of points (n, 3): pixels and metres; not finite where a point is not before the camera."""
    z = np.where(points_in_cam[:, 2] > 0, points_in_cam[:, 2], np.nan)
    u = camera.fx * points_in_cam[:, 0] / z + camera.cx
    v = camera.fy * points_in_cam[:, 1] / z + camera.cy
    return np.stack([u, v, z], axis=1)


def back_project(seen: Floats, camera: Camera) -> Floats:
    """Points (n, 3) in the camera's axes of columns u, v, z (n, 3)."""
    z = seen[:, 2]
    return np.stack([(seen[:, 0] - camera.cx) / camera.fx * z, (seen[:, 1] - camera.cy) / camera.fy * z, z], axis=1)


def sound_depth(depth: Floats32, pixels: Ints, min_range_m: float, max_range_m: float) -> tuple[Floats32, Bools]:
    """The median depth (n,) of the 3x3 pixels around each, and where it is in range, and neither on an edge nor beside
    what is nearer.
    """
    window = _around(depth, pixels, np.arange(-1, 2))
    middle = np.median(window, axis=1)
    in_range = (window.min(axis=1) >= min_range_m) & (window.max(axis=1) <= max_range_m)
    flat = window.max(axis=1) - window.min(axis=1) <= EDGE_STEP * middle
    beside = _around(depth, pixels, np.round(BESIDE * depth.shape[1] * np.linspace(-1, 1, 5)).astype(np.int64))
    occluded = ((beside > 0) & (beside < (1 - NEARER) * middle[:, None])).any(axis=1)
    return middle.astype(np.float32), np.asarray(in_range & flat & ~occluded)


def _around(depth: Floats32, pixels: Ints, steps: Ints) -> Floats32:
    """The depths (n, k²) at these k steps along rows and columns from each pixel, the image's edge beyond it."""
    height, width = depth.shape
    v = np.clip(pixels[:, 1, None] + np.repeat(steps, len(steps)), 0, height - 1)
    u = np.clip(pixels[:, 0, None] + np.tile(steps, len(steps)), 0, width - 1)
    return np.asarray(depth[v, u])
