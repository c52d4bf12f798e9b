"""What a COLMAP model holds, as plain arrays: of all its images and points at once, which pycolmap gives one by one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from hodge_pipeline.types import Bools, Floats, Ints

NO_POINT = -1
"""COLMAP's mark of an observation of no point, 2^64 − 1, as a signed number."""


def matrix_of(motion: Any) -> Floats:
    """The motion (4, 4) of one of pycolmap's `Rigid3d`."""
    return np.vstack([motion.matrix(), [0.0, 0.0, 0.0, 1.0]])


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
    """The model's points: `ids (P,)`, ascending, `xyz (P, 3)`, and each one's track as `image_ids`, `columns` cut by
    `offsets`.
    """

    ids: Ints
    xyz: Floats
    offsets: Ints
    image_ids: Ints
    columns: Ints

    @cached_property
    def owners(self) -> Ints:
        """The row (T,) of the point that each entry of a track belongs to."""
        return np.repeat(np.arange(len(self.ids)), np.diff(self.offsets))

    def seen_by(self, kept: Bools) -> Points:
        """The points with these entries (T,) of their tracks alone."""
        counts = np.bincount(self.owners[kept], minlength=len(self.ids))
        return Points(self.ids, self.xyz, np.r_[0, np.cumsum(counts)], self.image_ids[kept], self.columns[kept])

    def rows_of(self, ids: Ints) -> Ints:
        """The rows (N,) of points by their ids (N,), −1 of those that are not there."""
        if not len(self.ids):
            return np.full(len(ids), -1)
        rows = np.minimum(np.searchsorted(self.ids, ids), len(self.ids) - 1)
        return np.where(self.ids[rows] == ids, rows, -1)


@dataclass(frozen=True)
class Model:
    """A COLMAP model: cameras by id, images in the order of their names, points; `files` it was read from, `notes`."""

    cameras: Mapping[int, CameraRecord]
    images: Sequence[ImageRecord]
    points: Points
    files: tuple[Path, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def world_from_cam(self) -> Floats:
        """The poses (N, 4, 4) of the images."""
        return np.array([image.world_from_cam for image in self.images]).reshape(-1, 4, 4)

    @cached_property
    def image_rows(self) -> Ints:
        """The row (T,) of the image that each entry of a track names."""
        ids = np.array([image.image_id for image in self.images], np.int64)
        order = np.argsort(ids)
        return np.asarray(order[np.searchsorted(ids[order], self.points.image_ids)], np.int64)

    @cached_property
    def entries(self) -> list[Ints]:
        """The rows of the entries of tracks that name each image, ascending."""
        order = np.argsort(self.image_rows, kind="stable")
        return np.split(order, np.searchsorted(self.image_rows[order], np.arange(1, len(self.images))))

    @cached_property
    def keypoints(self) -> Ints:
        """For each entry of a track the row of its image and the number of its observation there (T, 2)."""
        return np.stack([self.image_rows, self.points.columns], axis=1).astype(np.int64)

    @cached_property
    def track_lengths(self) -> Ints:
        """For each entry of a track how many entries the track has (T,)."""
        return np.diff(self.points.offsets)[self.points.owners]

    def moved(self, cameras: Mapping[int, CameraRecord], images: Sequence[ImageRecord], xyz: Floats) -> Model:
        """The same tracks with other cameras, poses and positions (P, 3); what tracks alone tell is not found anew."""
        out = replace(self, cameras=cameras, images=images, points=replace(self.points, xyz=xyz))
        vars(out.points)["owners"] = self.points.owners
        vars(out).update(
            {name: getattr(self, name) for name in ("image_rows", "entries", "keypoints", "track_lengths")}
        )
        return out
