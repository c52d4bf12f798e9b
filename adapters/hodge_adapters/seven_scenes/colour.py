"""Unregistered colour of a Kinect: detected by edges, and reprojected onto the pixels of the depth image."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from hodge_adapters.images import pixels
from hodge_adapters.images.second_camera import SecondCamera, on_depth_pixels
from hodge_pipeline.errors import SourceError
from hodge_pipeline.types import Bytes, Camera, Floats, Floats32
from hodge_pipeline.types.arrays import evenly
from hodge_pipeline.types.image_edges import FEWEST_EDGES, change_along_rows, depth_edges

COLOUR_FOCAL, BASELINE_M = 525.0, 0.025
"""Focal length in pixels and baseline of a Kinect's colour camera as built: parallel to the depth camera."""
SIZE = 640, 480
FRAMES, FEWEST_FRAMES = 8, 3
"""Frames tested, evenly spread; frames that are needed."""
LEAST_CHANGE = 1.0
"""Grey levels added for noise, so that an image of one even shade has no say."""
SURE = 2.5
"""Standard errors of the mean over the frames that show unregistered colour. Red kitchen and stairs have 7 to 10;
fr1/xyz, fr1/rpy, fr3/cabinet and ICL-NUIM, whose colour is registered, 0 to −13.
"""


@dataclass(frozen=True)
class DepthFile:
    """A depth image, the depth camera, stored units per metre, and the values that mean no depth."""

    path: Path
    camera: Camera
    units_per_metre: float
    no_depth: tuple[int, ...]

    @property
    def size(self) -> tuple[int, int]:
        """Width and height."""
        return self.camera.width, self.camera.height

    def read(self) -> Floats32:
        """The image (H, W), metres."""
        return pixels.read_depth(
            self.path, units_per_metre=self.units_per_metre, no_depth=self.no_depth, size=self.size
        )


def is_unregistered(colour: Sequence[Path], depth: Sequence[DepthFile]) -> bool:
    """Whether colour edges surely fit depth edges better as seen by a Kinect's colour camera than without parallax.

    Images that cannot be read are left out; False where too few are left.
    """
    if len(depth) < FEWEST_FRAMES or depth[0].size != SIZE:
        return False
    gains = []
    for row in evenly(len(depth), FRAMES):
        own = depth[row]
        try:
            gains.append(_gain(own.read(), pixels.read_colour(colour[row], size=own.size), own.camera))
        except (SourceError, OSError):
            continue
    known = np.array(gains)[np.isfinite(gains)]
    return len(known) >= FEWEST_FRAMES and bool(known.mean() > SURE * known.std() / np.sqrt(len(known)))


def _gain(depth_m: Floats32, colour: Bytes, camera: Camera) -> float:
    """Logarithm of the mean gradient of colour at depth edges as a Kinect's colour camera sees them, over that at their
    own pixels; NaN with too few edges.
    """
    change, (v, u, nearer_m) = change_along_rows(colour), depth_edges(depth_m)
    far = _at_infinity(np.asarray(u + 0.5, float), v.astype(float), camera)
    columns = np.round(far[0] - COLOUR_FOCAL * BASELINE_M / nearer_m).astype(np.int64)
    rows = np.round(far[1]).astype(np.int64)
    inside = (columns >= 0) & (columns < camera.width) & (rows >= 0) & (rows < camera.height)
    if inside.sum() < FEWEST_EDGES:
        return float("nan")
    beside, here = change[rows[inside], columns[inside]].mean(), change[v[inside], u[inside]].mean()
    return float(np.log((beside + LEAST_CHANGE) / (here + LEAST_CHANGE)))


def _at_infinity(u: Floats, v: Floats, camera: Camera) -> tuple[Floats, Floats]:
    """Columns and rows in the colour camera of pixels of the depth camera at infinite depth, without parallax."""
    wider_u, wider_v = COLOUR_FOCAL / camera.fx, COLOUR_FOCAL / camera.fy
    return wider_u * (u - camera.cx) + camera.cx, wider_v * (v - camera.cy) + camera.cy


def kinect_colour_camera(camera: Camera) -> SecondCamera:
    """A Kinect's colour camera, beside this depth camera."""
    colour = replace(camera, fx=COLOUR_FOCAL, fy=COLOUR_FOCAL)
    return SecondCamera(colour, (1.0, 0.0, 0.0, -BASELINE_M, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0))


def read_registered_colour(path: Path, depth: DepthFile) -> Bytes:
    """Colour (H, W, 3) of a Kinect on the pixels of its depth image, black outside the colour camera's view."""
    image = pixels.read_colour(path, size=depth.size)
    depth_m = _read_last(depth, _changed(depth.path))
    return on_depth_pixels(image, depth_m, depth.camera, kinect_colour_camera(depth.camera))


def read_depth(depth: DepthFile) -> Floats32:
    """The depth image (H, W), not decoded again where the frame's colour was read just now."""
    return _read_last(depth, _changed(depth.path)).copy()


@lru_cache(maxsize=1)
def _read_last(depth: DepthFile, changed: int) -> Floats32:
    return depth.read()


def _changed(path: Path) -> int:
    """When the file was last written, nanoseconds; 0 where that cannot be told: reading it says why."""
    try:
        return os.stat(path).st_mtime_ns
    except (OSError, ValueError):
        return 0
