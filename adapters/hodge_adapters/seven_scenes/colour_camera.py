"""Colour from a camera of its own beside the depth camera, brought onto the depth camera's pixels."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from hodge_adapters.images import pixels
from hodge_pipeline import se3
from hodge_pipeline.types import Bytes, Camera, Floats, Floats32

ASSUMED_DEPTH_M = 2.0
"""Where a whole image has no depth."""

NOMINAL = (1.0, 0.0, 0.0, -0.025, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0)
"""A Kinect's colour camera as built: 2.5 cm beside the depth camera, which sees it at its left, and parallel."""
LIRIS = (
    0.99996518, 0.00267651265, -0.00790410123, -0.0255589432,
    -0.00274093113, 0.999963028, -0.00815045208, 0.000101096363,
    0.00788199421, 0.00817183288, 0.999935546, 0.00203183217,
    0.0, 0.0, 0.0, 1.0,
)  # fmt: skip
"""The calibration of LIRIS's Kinect (projet.liris.cnrs.fr/voir/activities-dataset/kinect-calibration.html), which work
on localisation in 7-Scenes has used for its sensor (Brachmann and others, DSAC*)."""
KINECT_FOCAL = 525.0


@dataclass(frozen=True)
class ColourCamera:
    """The colour camera's intrinsics, and `colour_from_depth` (4x4 by rows): points from depth's axes into its own."""

    camera: Camera
    colour_from_depth: tuple[float, ...]

    @property
    def motion(self) -> Floats:
        """`colour_from_depth` (4, 4)."""
        return np.array(self.colour_from_depth).reshape(4, 4)


def read_registered_colour(
    path: Path,
    *,
    colour: ColourCamera,
    depth_path: Path,
    camera: Camera,
    units_per_metre: float,
    no_depth: tuple[int, ...],
) -> Bytes:
    """Colour (H, W, 3) on the pixels of the depth image: black where the colour camera does not look.

    Pixels without depth are taken to be as far as the median of the others. What the colour camera cannot see from
    where it stands gets the colour of what hides it: at 2.5 cm beside, a rim of a few pixels.
    """
    image = pixels.read_colour(path, size=(colour.camera.width, colour.camera.height))
    depth = pixels.read_depth(
        depth_path, units_per_metre=units_per_metre, no_depth=no_depth, size=(camera.width, camera.height)
    )
    columns, rows = colour_pixels(depth, camera, colour)
    return np.asarray(cv2.remap(image, columns, rows, cv2.INTER_LINEAR, borderValue=(0, 0, 0)), np.uint8)


def colour_pixels(depth_m: Floats32, camera: Camera, colour: ColourCamera) -> tuple[Floats32, Floats32]:
    """For each pixel of the depth image (H, W) the column and row where the colour camera sees it, -1 for nowhere."""
    valid = depth_m > 0
    far = float(np.median(depth_m[valid])) if valid.any() else ASSUMED_DEPTH_M
    z = np.where(valid, depth_m, np.float32(far)).astype(np.float64)
    v, u = np.indices(depth_m.shape, dtype=np.float64)
    points = np.stack([(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z], axis=-1)
    moved = se3.transform(colour.motion, points.reshape(-1, 3)).reshape(points.shape)
    ahead = moved[..., 2] > 1e-6
    depth = np.where(ahead, moved[..., 2], 1.0)
    columns = np.where(ahead, colour.camera.fx * moved[..., 0] / depth + colour.camera.cx, -1.0)
    rows = np.where(ahead, colour.camera.fy * moved[..., 1] / depth + colour.camera.cy, -1.0)
    return np.clip(columns, -1.0, 1e6).astype(np.float32), np.clip(rows, -1.0, 1e6).astype(np.float32)
