"""How far the points of a COLMAP model are from the keypoints that saw them; a point behind a camera has no error."""

from __future__ import annotations

import numpy as np

from hodge_adapters.colmap.cameras import colmap_camera
from hodge_adapters.colmap.pycolmap_import import pycolmap
from hodge_adapters.colmap.records import Model
from hodge_pipeline import se3
from hodge_pipeline.types import Floats, Ints

NO_ERROR = -1.0
"""COLMAP's mark of a point whose error is not known; its own mean leaves such points out."""
SENTINEL_PX = 1e100
"""pycolmap takes the root of the largest double, 1e154 px, for an observation behind a camera; a point's error is the
mean of its track's. No projection reaches this."""
LEAST_CAP_PX = 4.0
"""COLMAP's own limit (`filter_max_reproj_error`): beyond it an observation is wrong, and how far off tells no more."""
CAP_MEDIANS = 3.0
"""Of the median: where poses are disturbed by more than the limit, most errors still stay below the cap."""


def error_cap(errors_px: Floats) -> float:
    """The error beyond which an observation of these (N,) is wrong; those behind a camera do not count."""
    seen = errors_px[np.isfinite(errors_px)]
    return max(LEAST_CAP_PX, CAP_MEDIANS * float(np.median(seen))) if len(seen) else LEAST_CAP_PX


def reprojection_errors(model: Model) -> tuple[Ints, Floats]:
    """Every observation of a track: the row of its image and its column there (N, 2), and its error (N,) in pixels.

    Infinite where the point lies behind the camera, so that the camera cannot project it.
    """
    points = model.points
    row, owner = model.image_rows, points.owners
    errors_px = np.full(len(row), np.inf)
    for image, here in zip(model.images, model.entries, strict=True):
        if not len(here):
            continue
        in_cam = se3.transform(se3.inverse(image.world_from_cam), points.xyz[owner[here]])
        projected = np.asarray(colmap_camera(model.cameras[image.camera_id]).img_from_cam(in_cam))
        distance_px = np.linalg.norm(projected - image.pixels[points.columns[here]], axis=1)
        errors_px[here] = np.where(np.isfinite(distance_px), distance_px, np.inf)
    return np.stack([row, points.columns], axis=1).astype(np.int64), errors_px


def update_errors(reconstruction: pycolmap.Reconstruction) -> None:
    """Set the error of every point in place; `NO_ERROR` where one of its cameras has it behind."""
    reconstruction.update_point_3d_errors()
    for point in reconstruction.points3D.values():
        if not point.error < SENTINEL_PX:
            point.error = NO_ERROR
