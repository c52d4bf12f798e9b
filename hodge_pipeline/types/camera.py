"""The pinhole camera of an image, and cameras as rows of an array."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hodge_pipeline.types.arrays import Floats


@dataclass(frozen=True)
class Camera:
    """A pinhole camera: `u = fx x / z + cx`, `v = fy y / z + cy`, in pixels; `fy` is negative where y points up.

    The centre of the first pixel is (0, 0). `readout_s`: seconds from reading the first row to the last (rolling
    shutter); 0: all at once.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    readout_s: float = 0.0

    @property
    def matrix(self) -> Floats:
        """The 3x3 intrinsic matrix K, `(u, v, 1) ~ K p_cam`."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])


def camera_numbers(camera: Camera | None) -> list[float]:
    """Width, height, fx, fy, cx and cy of a camera; NaN without one."""
    if camera is None:
        return [np.nan] * 6
    return [camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy]


def camera_of(numbers: Floats) -> Camera | None:
    """The camera of six `camera_numbers`."""
    width, height, *pinhole = numbers.tolist()
    return None if np.isnan(numbers).any() else Camera(int(width), int(height), *pinhole)
