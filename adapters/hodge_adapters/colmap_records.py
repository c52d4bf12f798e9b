"""What a COLMAP model holds, as plain arrays, and the checks that its files agree with each other."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.errors import SourceError
from hodge_pipeline.types import Floats, Ints

NO_POINT = -1
REMEDY = "write the model again with `colmap model_converter`"

CAMERA_MODELS: Mapping[str, tuple[int, int]] = {
    "SIMPLE_PINHOLE": (0, 3),
    "PINHOLE": (1, 4),
    "SIMPLE_RADIAL": (2, 4),
    "RADIAL": (3, 5),
    "OPENCV": (4, 8),
    "OPENCV_FISHEYE": (5, 8),
    "FULL_OPENCV": (6, 12),
    "FOV": (7, 5),
    "SIMPLE_RADIAL_FISHEYE": (8, 4),
    "RADIAL_FISHEYE": (9, 5),
    "THIN_PRISM_FISHEYE": (10, 12),
    "RAD_TAN_THIN_PRISM_FISHEYE": (11, 16),
    "SIMPLE_DIVISION": (12, 4),
    "DIVISION": (13, 5),
    "SIMPLE_FISHEYE": (14, 3),
    "FISHEYE": (15, 4),
    "EUCM": (16, 6),
    "EQUIRECTANGULAR": (17, 2),
}
"""Number and parameter count of each camera model, as the files hold them."""


@dataclass(frozen=True)
class CameraRecord:
    """One camera: its model by name, its size and parameters in COLMAP's pixels (the corner of the image is 0, 0)."""

    camera_id: int
    model: str
    width: int
    height: int
    params: tuple[float, ...]


@dataclass(frozen=True)
class ImageRecord:
    """One posed image; `pixels (N, 2)` are its observations, `point_ids (N,)` their points or `NO_POINT`."""

    image_id: int
    world_from_cam: Floats
    camera_id: int
    name: str
    pixels: Floats
    point_ids: Ints


@dataclass(frozen=True)
class Points:
    """The model's points: `ids (P,)`, `xyz (P, 3)`, and each one's track as `image_ids`, `columns` cut by `offsets`."""

    ids: Ints
    xyz: Floats
    offsets: Ints
    image_ids: Ints
    columns: Ints

    @cached_property
    def owners(self) -> Ints:
        """The row (T,) of the point that each entry of a track belongs to."""
        return np.repeat(np.arange(len(self.ids)), np.diff(self.offsets))


@dataclass(frozen=True)
class Model:
    """A COLMAP model: cameras by id, images in the order of their names, points; `files` it was read from, `notes`."""

    cameras: Mapping[int, CameraRecord]
    images: Sequence[ImageRecord]
    points: Points
    files: tuple[Path, ...]
    notes: tuple[str, ...] = ()

    @cached_property
    def image_rows(self) -> Ints:
        """The row (T,) of the image that each entry of a track names."""
        ids = np.array([image.image_id for image in self.images], np.int64)
        order = np.argsort(ids)
        return np.asarray(order[np.searchsorted(ids[order], self.points.image_ids)], np.int64)


def no_points() -> Points:
    """A model without structure."""
    none = np.zeros(0, np.int64)
    return Points(none, np.zeros((0, 3)), np.zeros(1, np.int64), none, none)


def camera_record(
    where: str, camera_id: int, model: str, size: tuple[int, int], params: Sequence[float]
) -> CameraRecord:
    """The camera, if its numbers can be one. Raises `SourceError`."""
    if model not in CAMERA_MODELS:
        raise SourceError(f"{where}: camera {camera_id} has the unknown model {model!r}: convert it to OPENCV")
    expected = CAMERA_MODELS[model][1]
    if len(params) != expected:
        raise SourceError(f"{where}: camera {camera_id}: {model} has {expected} parameters, not {len(params)}")
    if not np.isfinite(params).all() or not (0 < size[0] < 1 << 16 and 0 < size[1] < 1 << 16):
        raise SourceError(f"{where}: camera {camera_id} of {size[0]}x{size[1]} has no sound numbers: mend the file")
    return CameraRecord(camera_id, model, *size, tuple(params))


def world_from_cam(where: str, quat_wxyz: Sequence[float], translation: Sequence[float]) -> Floats:
    """COLMAP's `cam_from_world`, inverted: the one place where this is done. Raises `SourceError`."""
    quat, moved = np.array(quat_wxyz, np.float64), np.array(translation, np.float64)
    if not np.isfinite(quat).all() or not np.isfinite(moved).all() or not 1e-6 < np.linalg.norm(quat) < 1e6:
        raise SourceError(f"{where}: its pose is not finite, or its quaternion is zero: leave the image out")
    return se3.inverse(se3.from_quat_xyzw(moved, quat[[1, 2, 3, 0]]))


def to_colmap(world_from_cams: Floats) -> tuple[Floats, Floats]:
    """COLMAP's `cam_from_world` as quaternions wxyz (N, 4) and translations (N, 3)."""
    cam_from_world = se3.inverse(world_from_cams)
    return se3.to_quat_xyzw(cam_from_world)[:, [3, 0, 1, 2]], cam_from_world[:, :3, 3]


def check_model(model: Model, folder: Path) -> None:
    """Raise `SourceError` where files contradict each other: cameras, names, observations and tracks."""
    if not model.images:
        raise SourceError(f"{folder}: the model has no image with a pose: give one that was reconstructed")
    for image in model.images:
        if image.camera_id not in model.cameras:
            raise SourceError(
                f"{folder}: image {image.name!r} has camera {image.camera_id}, which is not there: {REMEDY}"
            )
    for what, values in (("ids", [i.image_id for i in model.images]), ("names", [i.name for i in model.images])):
        if len(set(values)) < len(values):
            raise SourceError(f"{folder}: two images have the same {what[:-1]}: {REMEDY}")
    _check_tracks(model, folder)


def _check_tracks(model: Model, folder: Path) -> None:
    points = model.points
    if len(np.unique(points.ids)) < len(points.ids):
        raise SourceError(f"{folder}: a point is given twice: {REMEDY}")
    if not np.isfinite(points.xyz).all():
        wrong = points.ids[~np.isfinite(points.xyz).all(axis=1)][0]
        raise SourceError(f"{folder}: point {wrong} is not finite: {REMEDY}")
    owner = np.repeat(points.ids, np.diff(points.offsets))
    order = np.argsort(points.image_ids, kind="stable")
    sorted_ids = points.image_ids[order]
    seen = 0
    for image in model.images:
        rows = order[np.searchsorted(sorted_ids, image.image_id) : np.searchsorted(sorted_ids, image.image_id, "right")]
        seen += len(rows)
        columns = points.columns[rows]
        wrong = columns >= len(image.point_ids)
        if not wrong.any():
            # COLMAP takes an observation without a point as belonging to the track that names it.
            wrong = (image.point_ids[columns] != owner[rows]) & (image.point_ids[columns] != NO_POINT)
        if wrong.any():
            first = int(np.flatnonzero(wrong)[0])
            raise SourceError(
                f"{folder}: the track of point {owner[rows][first]} names observation {columns[first]} of image "
                f"{image.name!r}, which is not of that point: {REMEDY}"
            )
        known = np.isin(image.point_ids[image.point_ids != NO_POINT], points.ids)
        if not known.all():
            lost = image.point_ids[image.point_ids != NO_POINT][~known][0]
            raise SourceError(f"{folder}: image {image.name!r} observes point {lost}, which is not there: {REMEDY}")
    if seen < len(owner):
        raise SourceError(f"{folder}: {len(owner) - seen} entries of tracks name an image that is not there: {REMEDY}")
