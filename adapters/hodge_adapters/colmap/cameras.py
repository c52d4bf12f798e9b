"""COLMAP's camera models as pinhole cameras, and images undistorted into them.

COLMAP puts 0, 0 at the outer corner of the first pixel; here whole numbers are pixel centres, so half a pixel less.
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np

from hodge_adapters.colmap.depth import read_depth_map
from hodge_adapters.colmap.pycolmap_import import pycolmap
from hodge_adapters.colmap.records import CameraRecord
from hodge_adapters.images import pixels
from hodge_adapters.images.lens_models import HALF_PIXEL
from hodge_pipeline.errors import SourceError
from hodge_pipeline.types import Bytes, Camera, Floats, Floats32

UNDISTORTED = ("SIMPLE_PINHOLE", "PINHOLE")


def colmap_camera(record: CameraRecord) -> pycolmap.Camera:
    """The camera as pycolmap has it."""
    return pycolmap.Camera(model=record.model, width=record.width, height=record.height, params=np.array(record.params))


def pinhole_camera(record: CameraRecord, size: tuple[int, int]) -> Camera:
    """The pinhole camera of an image of this size, with the focal length and centre of the record.

    Raises `SourceError` where there is none: a panorama, or parameters that are no camera.
    """
    if record.model == "EQUIRECTANGULAR":
        raise SourceError(
            f"camera {record.camera_id}: EQUIRECTANGULAR is a panorama, which no pinhole camera sees: cut each into "
            "perspective views of one rig (as pycolmap's example panorama_sfm.py does) and reconstruct these; "
            "`colmap bundle_adjuster` adjusts the panoramas as they are"
        )
    scaled = scaled_camera(record, size)
    numbers = scaled.focal_length_x, scaled.focal_length_y, scaled.principal_point_x, scaled.principal_point_y
    if not np.isfinite(numbers).all() or min(numbers[:2]) <= 0:
        raise SourceError(f"camera {record.camera_id}: fx fy cx cy = {numbers} is no camera: mend its line")
    fx, fy, cx, cy = map(float, numbers)
    return Camera(*size, fx, fy, cx - HALF_PIXEL, cy - HALF_PIXEL)


def scaled_camera(record: CameraRecord, size: tuple[int, int]) -> pycolmap.Camera:
    """The camera for an image of another size."""
    camera = colmap_camera(record)
    if size != (record.width, record.height):
        camera.rescale(*size)
    return camera


@lru_cache(maxsize=4)
def undistortion(record: CameraRecord, size: tuple[int, int]) -> tuple[Floats32, Floats32]:
    """For each pixel of the pinhole camera (H, W) the column and row in the distorted image, -1 where it has none."""
    camera = pinhole_camera(record, size)
    v, u = np.mgrid[0 : camera.height, 0 : camera.width].astype(np.float64)
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)], axis=-1)
    pixels: Floats = scaled_camera(record, size).img_from_cam(rays.reshape(-1, 3)) - HALF_PIXEL
    pixels[~np.isfinite(pixels).all(axis=1)] = -1.0
    columns, rows = np.clip(pixels, -1.0, 1e6).astype(np.float32).reshape(*u.shape, 2).transpose(2, 0, 1)
    return np.ascontiguousarray(columns), np.ascontiguousarray(rows)


def read_sensor_depth(
    path: Path, *, record: CameraRecord, size: tuple[int, int], units_per_metre: float, no_depth: tuple[int, ...]
) -> Floats32:
    """Depth (H, W) in metres of a sensor's image, undistorted where the camera distorts."""
    depth = pixels.read_depth(path, units_per_metre=units_per_metre, no_depth=no_depth, size=size)
    return undistorted_depth(depth, record, size)


def read_stereo_depth(path: Path, *, record: CameraRecord, size: tuple[int, int], metres_per_unit: float) -> Floats32:
    """Depth (H, W) in metres of one of COLMAP's depth maps, undistorted where the camera distorts."""
    depth = read_depth_map(path, size) * np.float32(metres_per_unit)
    return undistorted_depth(depth, record, size)


def undistorted_depth(depth: Floats32, record: CameraRecord, size: tuple[int, int]) -> Floats32:
    """The nearest measurement for each pixel of the pinhole camera: depths are never blended. z stays what it is."""
    if record.model in UNDISTORTED:
        return depth
    columns, rows = undistortion(record, size)
    return np.asarray(cv2.remap(depth, columns, rows, cv2.INTER_NEAREST, borderValue=0.0), np.float32)


def read_undistorted_colour(path: Path, *, record: CameraRecord, size: tuple[int, int]) -> Bytes:
    """Colour (H, W, 3) on the pixels of the pinhole camera."""
    colour = pixels.read_colour(path)
    height, width = colour.shape[:2]
    if record.model in UNDISTORTED:
        if (width, height) == size:
            return colour
        return np.asarray(cv2.resize(colour, size, interpolation=cv2.INTER_AREA), np.uint8)
    if (width, height) != size:
        colour = np.asarray(cv2.resize(colour, size, interpolation=cv2.INTER_AREA), np.uint8)
    return pixels.resampled_colour(colour, *undistortion(record, size))
