"""Images of a lens that distorts, read as a pinhole camera would have taken them.

Depth that is registered to colour shares the colour image's distortion, so both are bent back alike: colour between
its pixels, depth from the nearest one, since a depth between two surfaces is on neither.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeAlias

import cv2
import numpy as np

from hodge_adapters.images import pixels
from hodge_pipeline.errors import SourceError
from hodge_pipeline.types import Bytes, Camera, EncodedImage, Floats32

Maps: TypeAlias = tuple[Any, Any]
JPEG_QUALITY = 90


@dataclass(frozen=True)
class Lens:
    """The camera that the images are to have, and its lens's `k1 k2 p1 p2 k3` (Brown's model, as OpenCV's)."""

    camera: Camera
    distortion: tuple[float, float, float, float, float]


@lru_cache(maxsize=4)
def _maps(lens: Lens) -> Maps:
    """Where (H, W) in the distorted image each pixel of the pinhole's comes from: columns, rows."""
    size = lens.camera.width, lens.camera.height
    matrix = lens.camera.matrix
    columns, rows = cv2.initUndistortRectifyMap(
        matrix, np.array(lens.distortion), np.eye(3), matrix, size, cv2.CV_32FC1
    )
    return columns, rows


def straight_depth(read: Callable[[], Floats32], lens: Lens) -> Floats32:
    """The depth image, straight; 0 where the pinhole sees past the edge of what was measured."""
    columns, rows = _maps(lens)
    return np.asarray(cv2.remap(read(), columns, rows, cv2.INTER_NEAREST, borderValue=0.0), np.float32)


def straight_colour(read: Callable[[], Bytes], lens: Lens) -> Bytes:
    """The colour image, straight; black past its edge."""
    columns, rows = _maps(lens)
    return np.asarray(cv2.remap(read(), columns, rows, cv2.INTER_LINEAR), np.uint8)


def encoded_straight_depth(read: Callable[[], Floats32], lens: Lens, units_per_metre: float) -> EncodedImage:
    """The straight depth image as PNG, in the units that the files have."""
    stored = np.clip(np.round(straight_depth(read, lens) * units_per_metre), 0, 65535).astype(np.uint16)
    return EncodedImage(_encoded(".png", stored, []), "image/png", units_per_metre)


def encoded_straight_colour(read: Callable[[], Bytes], lens: Lens) -> EncodedImage:
    """The straight colour image as JPEG."""
    return _jpeg(straight_colour(read, lens))


def encoded_colour(path: Path, size: tuple[int, int]) -> EncodedImage:
    """The file's bytes untouched where it has the camera's (width, height), else the image of that size as JPEG."""
    fits = pixels.image_size(path) == size
    return pixels.encoded(path) if fits else _jpeg(pixels.read_colour(path, size=size))


def _jpeg(image: Bytes) -> EncodedImage:
    contents = _encoded(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    return EncodedImage(contents, "image/jpeg")


def _encoded(kind: str, image: Any, options: list[int]) -> bytes:
    done, buffer = cv2.imencode(kind, image, options)
    if not done:
        raise SourceError(f"an image of {image.shape} cannot be written as {kind}: is there memory left?")
    return bytes(buffer)
