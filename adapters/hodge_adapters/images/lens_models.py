"""The parameters of COLMAP's camera models by name, and which of them nerfstudio has."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from hodge_pipeline.types import Camera, ImageFile

HALF_PIXEL = 0.5
"""COLMAP and nerfstudio put 0, 0 at the outer corner of the first pixel; here whole numbers are pixel centres."""

PERSPECTIVE, FISHEYE = "OPENCV", "OPENCV_FISHEYE"
"""nerfstudio's names: Brown's polynomial (k1, k2, k3, p1, p2), and Kannala's and Brandt's (k1 to k4)."""

NAMES: Mapping[str, tuple[str, str]] = {
    "SIMPLE_PINHOLE": (PERSPECTIVE, "f cx cy"),
    "PINHOLE": (PERSPECTIVE, "fx fy cx cy"),
    "SIMPLE_RADIAL": (PERSPECTIVE, "f cx cy k1"),
    "RADIAL": (PERSPECTIVE, "f cx cy k1 k2"),
    "OPENCV": (PERSPECTIVE, "fx fy cx cy k1 k2 p1 p2"),
    "FULL_OPENCV": (PERSPECTIVE, "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6"),
    "SIMPLE_RADIAL_FISHEYE": (FISHEYE, "f cx cy k1"),
    "RADIAL_FISHEYE": (FISHEYE, "f cx cy k1 k2"),
    "OPENCV_FISHEYE": (FISHEYE, "fx fy cx cy k1 k2 k3 k4"),
}
RATIONAL = ("k4", "k5", "k6")
"""Of FULL_OPENCV: the denominator, which nerfstudio does not have."""


def pinhole_params(camera: Camera) -> tuple[float, float, float, float]:
    """Fx fy cx cy in COLMAP's pixels."""
    return camera.fx, camera.fy, camera.cx + HALF_PIXEL, camera.cy + HALF_PIXEL


def image_file(path: Path, camera: Camera, lens: str = "PINHOLE", distortion: tuple[float, ...] = ()) -> ImageFile:
    """An image of this camera with the coefficients of its lens in the order of COLMAP's model."""
    return ImageFile(path, camera.width, camera.height, lens, (*pinhole_params(camera), *distortion))


def named(image: ImageFile) -> tuple[str, dict[str, float]] | None:
    """The camera model and its parameters by nerfstudio's names; None where nerfstudio has no such lens."""
    if image.lens not in NAMES:
        return None
    model, names = NAMES[image.lens]
    values = dict(zip(names.split(), image.params, strict=True))
    if model == PERSPECTIVE and any(values.pop(name, 0.0) for name in RATIONAL):
        return None
    focal = values.pop("f", None)
    fx, fy = (focal, focal) if focal is not None else (values.pop("fx"), values.pop("fy"))
    size = {"w": image.width, "h": image.height}
    return model, {**size, "fl_x": fx, "fl_y": fy, **values}
