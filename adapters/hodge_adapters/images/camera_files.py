"""Pinhole intrinsics from the small files that lie beside image sequences."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from hodge_adapters.images.headers import MAX_SIDE
from hodge_adapters.images.pixels import common_size, same_shape
from hodge_adapters.json_files import number, numbers, read_json, whole
from hodge_adapters.text_rows import read_rows, read_text, to_floats
from hodge_pipeline.errors import CameraError, SourceError
from hodge_pipeline.types import Camera

_ENTRY = re.compile(r"^\s*\"?(?:Camera1?\.)?(\w+)\"?\s*[:=]\s*([-+0-9.eE]+)\s*[,;]?\s*(?:#.*)?$", re.MULTILINE)
"""A line such as `fx: 525` or `Camera1.fx: 525`: of ORB-SLAM3's two cameras the first."""
_FISHEYE = re.compile(r"^\s*\"?Camera1?\.type\"?\s*:\s*\"?(Kannala\w*)", re.MULTILINE)
_DISTORTION = ("k1", "k2", "k3", "p1", "p2")
CAMERA_FILES = (
    "intrinsics.txt",
    "camera-intrinsics.txt",
    "camera-intrinsics.color.txt",
    "camera.yaml",
    "camera.txt",
    "calibration.yaml",
    "calibration.txt",
    "camera_intrinsic.json",
    "camera_intrinsics.json",
    "intrinsic.json",
    "intrinsic/intrinsic_depth.txt",
    "cam_params.json",
    "camera_matrix.csv",
    "K.txt",
    "info.txt",
    "TUM1.yaml",
    "TUM2.yaml",
    "TUM3.yaml",
)
"""Usual names, also of Open3D, whose recordings of a RealSense or an Azure Kinect have `intrinsic.json`, of tools in
7-Scenes' layout (`camera-intrinsics.color.txt`: depth is registered to colour), ScanNet's exporter, Replica as
NICE-SLAM renders it, Stray Scanner, deep-video-mvs, BundleFusion and ORB-SLAM."""
LONGEST_READOUT_S = 1.0
"""Upper bound on a rolling shutter's read-out time: slower cameras give no video."""
_SUPPORTED = "`fx fy cx cy [width height]` on one line, a 3x3 matrix, `fx: …` lines, or Open3D's JSON"


@dataclass(frozen=True)
class Intrinsics:
    """Intrinsics in pixels; `size` (width, height) and `units_per_metre` of depth where the file says so.

    `distorted`: the file states lens distortion; `distortion`: its `k1 k2 p1 p2 k3`, if known; `readout_s`: of the
    rolling shutter, 0 where unknown.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    size: tuple[int, int] | None = None
    units_per_metre: float | None = None
    distorted: bool = False
    distortion: tuple[float, float, float, float, float] | None = None
    readout_s: float = 0.0

    def camera(self, size: tuple[int, int]) -> Camera:
        """The camera, of the file's own (width, height), or of `size` where it has none."""
        width, height = self.size or size
        return Camera(width, height, self.fx, self.fy, self.cx, self.cy, self.readout_s)

    def camera_of(self, images: Sequence[Path], notes: list[str]) -> Camera:
        """The camera of these images; intrinsics of another size are scaled, with a note.

        Raises `CameraError` where the aspect ratios differ.
        """
        size = common_size(images)
        told = self.camera(size)
        if not same_shape((told.width, told.height), size):
            raise CameraError(
                f"{images[0].parent}: images of {size[0]}x{size[1]}, but intrinsics of {told.width}x{told.height}", size
            )
        if (told.width, told.height) != size:
            notes.append(f"intrinsics of {told.width}x{told.height} are scaled to the images' {size[0]}x{size[1]}")
        camera = resized(told, size)
        notes.extend(filter(None, [principal_point_note(camera)]))
        return camera


def find_camera_file(folder: Path) -> Path | None:
    """The camera file of a folder, by its usual names."""
    return next((folder / name for name in CAMERA_FILES if (folder / name).is_file()), None)


def resized(camera: Camera, size: tuple[int, int]) -> Camera:
    """The camera of the same view in images of this (width, height)."""
    across, down = size[0] / camera.width, size[1] / camera.height
    return replace(
        camera,
        width=size[0],
        height=size[1],
        fx=camera.fx * across,
        fy=camera.fy * down,
        cx=(camera.cx + 0.5) * across - 0.5,
        cy=(camera.cy + 0.5) * down - 0.5,
    )


def read_intrinsics(path: Path) -> Intrinsics:
    """The intrinsics in a file: one line `fx fy cx cy [width height]`, a 3x3 or 4x4 matrix K, `fx: …` lines as in
    ORB-SLAM's YAML (with `readout_s: …` for a rolling shutter), Open3D's JSON, or BundleFusion's `info.txt`.

    Raises `SourceError` for anything else, for numbers that are no camera, and for a fisheye.
    """
    found = _from_json(path) if path.suffix == ".json" else _from_text(path)
    if found is None:
        raise SourceError(f"{path}: no intrinsics found: write {_SUPPORTED}")
    return checked(found, str(path))


def checked(found: Intrinsics, where: str) -> Intrinsics:
    """The intrinsics, unchanged. Raises `SourceError` where they are no pinhole camera."""
    pinhole = (found.fx, found.fy, found.cx, found.cy)
    scale = found.units_per_metre
    if not abs(found.readout_s) < LONGEST_READOUT_S:
        raise SourceError(f"{where}: readout_s {found.readout_s:g} is no time in seconds in which an image is read")
    if found.size is not None and min(found.size) <= 0:
        raise SourceError(f"{where}: width and height are no whole numbers from 1 to {MAX_SIDE - 1}: mend them")
    if not all(map(math.isfinite, pinhole)) or found.fx <= 0 or found.fy == 0 or (scale and not 0 < scale < math.inf):
        raise SourceError(f"{where}: fx fy cx cy = {pinhole} is no pinhole camera: write {_SUPPORTED}")
    return found


def principal_point_note(camera: Camera) -> str | None:
    """A note where the principal point lies outside the image, a sign of intrinsics of another size; else None."""
    if 0 <= camera.cx <= camera.width and 0 <= camera.cy <= camera.height:
        return None
    centre = f"({camera.cx:g}, {camera.cy:g})"
    return f"the principal point {centre} lies outside the {camera.width}x{camera.height} image: check the intrinsics"


def _from_text(path: Path) -> Intrinsics | None:
    text = read_text(path)
    return _from_info(text) or _from_entries(text, path) or _from_numbers(path)


def _from_numbers(path: Path) -> Intrinsics | None:
    rows = [to_floats(row.fields) for row in read_rows(path)]
    if len(rows) == 1 and rows[0] and len(rows[0]) in (4, 6):
        fx, fy, cx, cy, *size = rows[0]
        if not size:
            return Intrinsics(fx, fy, cx, cy)
        # Two more numbers may be distortion coefficients instead: those are never whole.
        are_whole = all(value.is_integer() and value >= 1 for value in size)
        return Intrinsics(fx, fy, cx, cy, _size(*size)) if are_whole else None
    if len(rows) in (3, 4) and all(row and len(row) == len(rows) for row in rows):
        k = [row for row in rows if row]
        return Intrinsics(k[0][0], k[1][1], k[0][2], k[1][2])
    return None


def _from_info(text: str) -> Intrinsics | None:
    """BundleFusion's `m_name = values`: of depth, whose matrix is 4x4 by rows."""
    values = {name: to_floats(rest.split()) or [] for name, rest in re.findall(r"m_(\w+) = (.*)", text)}
    k, size = values.get("calibrationDepthIntrinsic", []), (values.get("depthWidth"), values.get("depthHeight"))
    if len(k) != 16 or not size[0] or not size[1]:
        return None
    return Intrinsics(k[0], k[5], k[2], k[6], _size(size[0][0], size[1][0]))


def _size(width: Any, height: Any) -> tuple[int, int]:
    """Width and height in pixels, 0 for a value that is no whole number in range."""
    return whole(width, 1, MAX_SIDE) or 0, whole(height, 1, MAX_SIDE) or 0


def _from_entries(text: str, path: Path) -> Intrinsics | None:
    entries = {name: to_floats([value]) for name, value in _ENTRY.findall(text)}
    values = {name: value[0] for name, value in entries.items() if value}
    if not {"fx", "fy", "cx", "cy"} <= values.keys():
        return None
    if (fisheye := _FISHEYE.search(text)) or values.get("k4"):
        lens = fisheye[1] if fisheye else "k4"
        raise SourceError(
            f"{path}: its lens ({lens}) is a fisheye, or has more than k1 k2 k3 p1 p2: undistort the images, then give "
            "their pinhole camera"
        )
    found = Intrinsics(
        values["fx"],
        values["fy"],
        values["cx"],
        values["cy"],
        units_per_metre=values.get("DepthMapFactor"),
        distorted=any(values.get(name) for name in _DISTORTION),
        distortion=_distortion(values),
        readout_s=values.get("readout_s", 0.0),
    )
    if {"width", "height"} <= values.keys():
        return replace(found, size=_size(values["width"], values["height"]))
    return found


def _distortion(values: dict[str, float]) -> tuple[float, float, float, float, float] | None:
    """Brown's coefficients, None where there are none; a missing one is zero."""
    k1, k2, p1, p2, k3 = (values.get(name, 0.0) for name in ("k1", "k2", "p1", "p2", "k3"))
    return (k1, k2, p1, p2, k3) if any((k1, k2, p1, p2, k3)) else None


def _from_json(path: Path) -> Intrinsics:
    """Open3D's `camera_intrinsic.json`: the matrix is stored by columns; its recordings have a `depth_scale` too. Or
    NICE-SLAM's `cam_params.json`, whose `camera` has fx, fy, cx, cy, w, h and scale.
    """
    content = read_json(path)
    if isinstance(camera := content.get("camera"), dict):
        fx, fy, cx, cy = (number(camera.get(name)) or math.nan for name in ("fx", "fy", "cx", "cy"))
        return Intrinsics(fx, fy, cx, cy, _size(camera.get("w"), camera.get("h")), number(camera.get("scale")))
    matrix = numbers(content.get("intrinsic_matrix"), 9, f"{path}: intrinsic_matrix").tolist()
    size = _size(content.get("width"), content.get("height"))
    return Intrinsics(matrix[0], matrix[4], matrix[6], matrix[7], size, number(content.get("depth_scale")))
