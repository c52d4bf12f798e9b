"""Two clouds upon each other as a picture: blue and orange, by a z-buffer in numpy."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.types import Bytes, Floats, Floats32, PointCloud

WIDTH, HEIGHT = 360, 270
FIRST, SECOND = np.array([0, 114, 178], np.float32), np.array([230, 120, 0], np.float32)
AMBIENT = 0.45
PAPER = 255
DOT_PX = 2


@dataclass(frozen=True)
class View:
    """Axes (3, 3) right, down, ahead as rows, in the axes of cloud i; the centre there; metres per pixel."""

    axes: Floats
    centre: Floats
    metres_per_pixel: float


def views(points_in_i: Floats, up_in_i: Floats) -> tuple[View, View]:
    """How camera i looks, and from above: both hold all of the points (N, 3)."""
    ahead = np.eye(3)[2]
    across = np.cross(-up_in_i, ahead)
    across /= max(float(np.linalg.norm(across)), 1e-9)
    above = np.stack([across, np.cross(-up_in_i, across), -up_in_i])
    return _holding(points_in_i, np.eye(3)), _holding(points_in_i, above)


def _holding(points_in_i: Floats, axes: Floats) -> View:
    low, high = np.percentile(points_in_i @ axes.T, [1, 99], axis=0)
    size = np.maximum(high - low, 0.05) * 1.1
    return View(axes, (low + high) / 2 @ axes, float(max(size[0] / WIDTH, size[1] / HEIGHT)))


def picture(first: PointCloud, second: PointCloud, i_from_j: Floats, view: View) -> Bytes:
    """Cloud i in blue and cloud j, moved by `i_from_j`, in orange (HEIGHT, WIDTH, 3), white where nothing is."""
    points = np.concatenate([first.points_in_cam, se3.transform(i_from_j, np.asarray(second.points_in_cam, float))])
    shades = np.concatenate([_shade(first, np.eye(3), FIRST, view), _shade(second, i_from_j[:3, :3], SECOND, view)])
    in_view = (points - view.centre) @ view.axes.T
    pixels = np.round(in_view[:, 1::-1] / view.metres_per_pixel + [HEIGHT / 2, WIDTH / 2]).astype(np.int64)
    far_first = np.argsort(-in_view[:, 2], kind="stable")
    dot = np.stack(np.meshgrid(np.arange(DOT_PX), np.arange(DOT_PX)), axis=-1).reshape(-1, 2)
    at = (pixels[far_first][:, None] + dot).reshape(-1, 2)
    colours = np.repeat(shades[far_first], len(dot), axis=0)
    image = np.full((HEIGHT, WIDTH, 3), PAPER, np.uint8)
    inside = (at >= 0).all(axis=1) & (at[:, 0] < HEIGHT) & (at[:, 1] < WIDTH)
    image[at[inside, 0], at[inside, 1]] = colours[inside]  # of a pixel hit twice the last, nearest point stays
    return image


def _shade(cloud: PointCloud, turn: Floats, tint: Floats32, view: View) -> Bytes:
    """The tint under a light at the eye; flat where the cloud has no normals."""
    facing = np.full(len(cloud), 0.6)
    if cloud.normals_in_cam is not None and np.asarray(cloud.normals_in_cam).any():
        facing = np.abs(np.asarray(cloud.normals_in_cam, float) @ (view.axes[2] @ turn))
    light = AMBIENT + (1 - AMBIENT) * facing
    return np.asarray(np.clip(tint * (0.35 + light)[:, None], 0, 250), np.uint8)
