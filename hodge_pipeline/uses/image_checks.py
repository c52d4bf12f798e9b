"""What images in memory must be before frames are made of them: each mistake is one line that says what to do."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hodge_pipeline.errors import SourceError
from hodge_pipeline.types import Bytes, Camera, Floats, Floats32

FARTHEST_M = 200.0
"""Metres: no depth sensor has half of its pixels beyond it; a room in millimetres has 1000 and more."""


def camera_of(camera: Camera | Floats, height: int, width: int) -> Camera:
    """The camera of images of this size, from ours or a matrix K (3, 3). Raises `SourceError` for what is none."""
    if not isinstance(camera, Camera):
        k = np.asarray(camera, float)
        if k.shape != (3, 3) or not np.isfinite(k).all() or (k[2] != (0, 0, 1)).any() or k[1, 0]:
            raise SourceError(
                f"the camera is {np.round(k, 3).tolist()}: expected K in pixels, [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]"
            )
        if k[0, 1]:
            raise SourceError(f"the camera has the skew {k[0, 1]:g}: undistort the images into a pinhole without one")
        camera = Camera(width, height, *(float(k[at]) for at in ((0, 0), (1, 1), (0, 2), (1, 2))))
    if (camera.width, camera.height) != (width, height):
        given = f"{camera.width}x{camera.height}"
        raise SourceError(f"the camera has {given} pixels, the depth images {width}x{height}: scale one of them")
    if camera.fx <= 0 or camera.fy == 0 or not (0 <= camera.cx <= width and 0 <= camera.cy <= height):
        given = f"fx {camera.fx:g}, fy {camera.fy:g}, cx {camera.cx:g}, cy {camera.cy:g}"
        raise SourceError(f"the camera has {given}: expected pixels of an image of {width}x{height}, fx above 0")
    return camera


def check_depths(depths_m: Sequence[Floats32]) -> None:
    """Raise `SourceError` for the first image that cannot be depth in metres, or has another size than the first."""
    size = np.shape(depths_m[0])
    for row, depth in enumerate(np.asarray(image) for image in depths_m):
        if depth.ndim != 2 or depth.shape != size:
            raise SourceError(
                f"depth image {row} has the shape {depth.shape}: expected {size if len(size) == 2 else '(H, W)'}"
            )
        if depth.dtype.kind != "f":
            raise SourceError(
                f"depth image {row} holds {depth.dtype}, as stored by a sensor: divide by its units per metre"
            )
        if not np.isfinite(depth).all() or (depth < 0).any():
            raise SourceError(
                f"depth image {row} has values that are not finite or below 0: set what is not measured to 0"
            )
        seen = depth[depth > 0]
        if len(seen) and np.median(seen) > FARTHEST_M:
            median = f"{np.median(seen):.0f} m"
            raise SourceError(
                f"depth image {row} has a median of {median}: divide by its units per metre (1000 for mm)"
            )


def check_colours(colours: Sequence[Bytes] | None, count: int, size: tuple[int, int]) -> None:
    """Raise `SourceError` where there is not one RGB image (H, W, 3) of 8 bit for each depth image."""
    if colours is None:
        return
    if len(colours) != count:
        raise SourceError(f"{len(colours)} colour images for {count} depth images: give one for each")
    for row, colour in enumerate(np.asarray(image) for image in colours):
        if colour.shape != (*size, 3) or colour.dtype != np.uint8:
            raise SourceError(
                f"colour image {row} is {colour.dtype} of the shape {colour.shape}: expected uint8 {(*size, 3)}, RGB"
            )
