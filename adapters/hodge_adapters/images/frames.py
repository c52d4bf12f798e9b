"""Lazy frames of a depth image and the colour image on the same pixel grid, undistorted where the lens is known.

Depth that is registered to colour shares the colour image's distortion, so both are undistorted: colour by linear
interpolation, depth from the nearest pixel, since a mean of two surfaces' depths is on neither.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, TypeAlias

import cv2
import numpy as np

from hodge_adapters.images import pixels
from hodge_adapters.images.camera_files import resized
from hodge_adapters.images.lens_models import image_file
from hodge_adapters.images.png import encoded_depth
from hodge_pipeline.errors import SourceError
from hodge_pipeline.types import Bytes, Camera, EncodedImage, Floats, Floats32, Frame, ImageFile

Maps: TypeAlias = tuple[Any, Any]
JPEG_QUALITY = 90
"""It changes pixels of fr1/rpy by 3.7 of 255 grey levels, in 49 kB an image; 95 by 3.4 in 76 kB."""


def image_frame(
    frame_id: int | str,
    stamp_s: float,
    camera: Camera,
    depth: Path,
    colour: Path | None,
    *,
    units_per_metre: float,
    no_depth: tuple[int, ...] = (0, 65535),
    world_from_cam: Floats,
    is_true: bool = False,
    sequence: str = "",
    lens: Lens | None = None,
    colour_delay_s: float = 0.0,
    colour_size: tuple[int, int] | None,
) -> Frame:
    """A frame that reads its images when asked, and then refuses those of another size than the camera.

    With a lens they are undistorted. Colour files of another size (`colour_size`) but the camera's aspect ratio are
    resized. A pose (4, 4) that is not finite means none; with `is_true` it is the ground truth too.
    """
    pose = world_from_cam if np.isfinite(world_from_cam).all() else None
    size = camera.width, camera.height
    frame = Frame(
        frame_id=frame_id,
        stamp_s=float(stamp_s),
        camera=camera,
        read_depth=partial(pixels.read_depth, depth, units_per_metre=units_per_metre, no_depth=no_depth, size=size),
        read_colour=partial(pixels.read_colour, colour, size=size) if colour else None,
        encoded_depth=partial(pixels.encoded, depth, units_per_metre=units_per_metre),
        encoded_colour=partial(encoded_colour, colour, size) if colour else None,
        image=None if colour is None else _image_file(colour, resized(camera, colour_size or size), lens),
        world_from_cam=pose,
        true_world_from_cam=pose if is_true else None,
        sequence=sequence,
        colour_delay_s=colour_delay_s,
    )
    return frame if lens is None else undistorted(frame, lens, units_per_metre)


def _image_file(path: Path, camera: Camera, lens: Lens | None) -> ImageFile:
    if lens is None:
        return image_file(path, camera)
    return image_file(path, camera, "FULL_OPENCV", (*lens.distortion, 0.0, 0.0, 0.0)[:8])


def undistorted(frame: Frame, lens: Lens, units_per_metre: float) -> Frame:
    """The frame with its depth and colour undistorted; depth is encoded in these units."""
    depth = frame.read_depth
    colour = partial(undistorted_colour, frame.read_colour, lens) if frame.read_colour else None
    return replace(
        frame,
        read_depth=partial(undistorted_depth, depth, lens) if depth else None,
        encoded_depth=partial(encoded_undistorted_depth, depth, lens, units_per_metre) if depth else None,
        read_colour=colour,
        encoded_colour=partial(as_jpeg, colour) if colour else None,
    )


@dataclass(frozen=True)
class Lens:
    """The pinhole camera of the undistorted images, and the distortion `k1 k2 p1 p2 k3` (Brown's, as in OpenCV), or
    with `k4 k5 k6` (the rational one).
    """

    camera: Camera
    distortion: tuple[float, ...]


@lru_cache(maxsize=4)
def _maps(lens: Lens) -> Maps:
    """Columns and rows (H, W) in the distorted image of each pixel of the undistorted one."""
    size = lens.camera.width, lens.camera.height
    matrix = lens.camera.matrix
    columns, rows = cv2.initUndistortRectifyMap(
        matrix, np.array(lens.distortion), np.eye(3), matrix, size, cv2.CV_32FC1
    )
    return columns, rows


def undistorted_depth(read: Callable[[], Floats32], lens: Lens) -> Floats32:
    """The depth image, undistorted; 0 where the pinhole camera sees beyond the edge of the original."""
    columns, rows = _maps(lens)
    return np.asarray(cv2.remap(read(), columns, rows, cv2.INTER_NEAREST, borderValue=0.0), np.float32)


def undistorted_colour(read: Callable[[], Bytes], lens: Lens) -> Bytes:
    """The colour image, undistorted; black beyond the edge of the original."""
    return pixels.resampled_colour(read(), *_maps(lens))


def encoded_undistorted_depth(read: Callable[[], Floats32], lens: Lens, units_per_metre: float) -> EncodedImage:
    """The undistorted depth image as PNG, in the units of the files."""
    stored = np.clip(np.round(undistorted_depth(read, lens) * units_per_metre), 0, 65535).astype(np.uint16)
    return EncodedImage(encoded_depth(stored) or _encoded(".png", stored, []), "image/png", units_per_metre)


def encoded_colour(path: Path, size: tuple[int, int]) -> EncodedImage:
    """The file's bytes untouched where it has the camera's (width, height), else the image of that size as JPEG."""
    fits = pixels.image_size(path) == size
    return pixels.encoded(path) if fits else as_jpeg(partial(pixels.read_colour, path, size=size))


def as_jpeg(read: Callable[[], Bytes]) -> EncodedImage:
    """The colour image (H, W, 3) that `read` gives, as JPEG."""
    contents = _encoded(".jpg", cv2.cvtColor(read(), cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    return EncodedImage(contents, "image/jpeg")


def _encoded(kind: str, image: Any, options: list[int]) -> bytes:
    done, buffer = cv2.imencode(kind, image, options)
    if not done:
        raise SourceError(f"an image of {image.shape} cannot be written as {kind}: is there memory left?")
    return bytes(buffer)
