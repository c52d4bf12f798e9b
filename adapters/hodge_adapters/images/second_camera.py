"""Colour of a second camera, brought onto the pixels of the depth image."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from hodge_adapters.images import pixels
from hodge_adapters.images.frames import Lens, undistorted_colour
from hodge_pipeline.types import Bytes, Camera, Floats32

ASSUMED_DEPTH_M = 2.0
"""Depth that an image without any is taken to have."""
MEDIAN_STRIDE = 4
"""Every so many rows and columns are used for the median depth: all would take as long as the rest."""


@dataclass(frozen=True)
class SecondCamera:
    """A camera beside the depth camera: `second_from_depth` is the rows of the 3x4 motion that takes points into its
    axes. Images are undistorted by `lens`, then brought to the camera's size.
    """

    camera: Camera
    second_from_depth: tuple[float, ...]
    lens: Lens | None = None


def colour_pixels(depth_m: Floats32, camera: Camera, second: SecondCamera) -> tuple[Floats32, Floats32]:
    """For each pixel of the depth image (H, W) the column and row where the second camera sees it, −1 behind it.

    Pixels without depth get the median depth.
    """
    some = depth_m[::MEDIAN_STRIDE, ::MEDIAN_STRIDE]
    known = some[some > 0]
    middle = np.median(known) if len(known) else ASSUMED_DEPTH_M
    nearness = 1 / np.where(depth_m > 0, depth_m, np.float32(middle))
    (x, y, z), (x_0, y_0, z_0) = _far_and_near(camera, second)
    ahead = z + z_0 * nearness
    behind = ahead <= 0
    ahead[behind] = 1
    columns, rows = (x + x_0 * nearness) / ahead, (y + y_0 * nearness) / ahead
    columns[behind], rows[behind] = -1, -1
    return np.asarray(columns, np.float32), np.asarray(rows, np.float32)


@lru_cache(maxsize=2)
def _far_and_near(camera: Camera, second: SecondCamera) -> tuple[tuple[Floats32, ...], tuple[np.float32, ...]]:
    """Homogeneous pixels of the second camera: of the rays of all pixels (H, W), and of the depth camera's centre."""
    motion = np.array(second.second_from_depth).reshape(3, 4)
    v, u = np.indices((camera.height, camera.width), dtype=float)
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)])
    far = np.tensordot(second.camera.matrix @ motion[:, :3], rays, axes=1).astype(np.float32)
    near = (second.camera.matrix @ motion[:, 3]).astype(np.float32)
    return tuple(far), tuple(near)


def on_depth_pixels(image: Bytes, depth_m: Floats32, camera: Camera, second: SecondCamera) -> Bytes:
    """Colour (H, W, 3) on the pixels of the depth image, black outside the second camera's view.

    Points hidden from the second camera get the colour of what hides them: a rim of a few pixels beside near things.
    """
    return pixels.resampled_colour(image, *colour_pixels(depth_m, camera, second))


def read_on_depth_pixels(
    read: Callable[[], Bytes], read_depth: Callable[[], Floats32], camera: Camera, second: SecondCamera
) -> Bytes:
    """The colour that `read` gives, undistorted, of the second camera's size, on the pixels of the depth image."""
    image = undistorted_colour(read, second.lens) if second.lens else read()
    size = second.camera.width, second.camera.height
    if image.shape[1::-1] != size:
        image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
    return on_depth_pixels(image, read_depth(), camera, second)
