"""Each body of a COLMAP model placed anew by the points that its images see, whatever pose it has."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from hodge_adapters.colmap.bodies import Bodies
from hodge_adapters.colmap.cameras import colmap_camera
from hodge_adapters.colmap.points import points_of_rays
from hodge_adapters.colmap.pycolmap_import import pycolmap
from hodge_adapters.colmap.records import Model, matrix_of
from hodge_pipeline import se3
from hodge_pipeline.types import Bools, Floats, Ints
from hodge_pipeline.types.arrays import evenly

LEAST_INLIERS = 12
"""Points; below it a wrong pose may have as many."""
MOST_POINTS = 1000
"""Of a body, evenly taken: RANSAC and the refinement cost in proportion, and the bundle adjustment uses them all."""
MOST_TRIALS = 1000
"""Enough to find three right ones of points a fifth of which are right (1 - 3e-4)."""
SEED = 0
"""Any: the same input gives the same poses."""


def resected(model: Model, bodies: Bodies, chosen: Bools | None = None) -> Floats:
    """Poses (B, 4, 4), those of the chosen bodies (B,) by RANSAC and refinement; all by default.

    Points are as they are, or where the bodies that were not chosen see them. A body that too few points agree on keeps
    its pose.
    """
    if chosen is not None:
        model = _seen_by_others(model, bodies, chosen)
    out = bodies.world_from_body.copy()
    body = bodies.body_of_image[model.image_rows]
    order = np.argsort(body, kind="stable")
    ends = np.searchsorted(body[order], np.arange(len(out) + 1))
    for number in range(len(out)) if chosen is None else np.flatnonzero(chosen):
        rows = order[ends[number] : ends[number + 1]]
        rows = rows[evenly(len(rows), MOST_POINTS)]
        pose = _placed(model, bodies, rows) if len(rows) >= LEAST_INLIERS else None
        if pose is not None:
            out[number] = pose
    return out


def _seen_by_others(model: Model, bodies: Bodies, chosen: Bools) -> Model:
    """The model with its points where the other bodies see them, and none of which fewer than two do."""
    points, owner = model.points, model.points.owners
    other = ~chosen[bodies.body_of_image[model.image_rows]]
    tracks = points.seen_by(other)
    xyz = points_of_rays(replace(model, points=tracks), model.world_from_cam)
    kept = (np.diff(tracks.offsets) >= 2)[owner]
    return replace(model, points=replace(points.seen_by(kept), xyz=xyz))


def _placed(model: Model, bodies: Bodies, rows: Ints) -> Floats | None:
    """`world_from_body` from these entries of tracks, all seen by one body."""
    images, row_of = np.unique(model.image_rows[rows], return_inverse=True)
    pixels = np.zeros((len(rows), 2))
    for at, image in enumerate(images):
        pixels[row_of == at] = model.images[image].pixels[model.points.columns[rows[row_of == at]]]
    xyz = model.points.xyz[model.points.owners[rows]]
    centre = xyz.mean(axis=0)  # far from the origin pycolmap's solvers, and single precision, are too coarse
    cameras = [colmap_camera(model.cameras[model.images[image].camera_id]) for image in images]
    found = _estimate(pixels, xyz - centre, row_of, cameras, [bodies.body_from_cam[image] for image in images])
    if found is None or found["num_inliers"] < LEAST_INLIERS:
        return None
    key = "cam_from_world" if len(images) == 1 else "rig_from_world"
    pose = matrix_of(found[key])
    body_from_world = bodies.body_from_cam[images[0]] @ pose if len(images) == 1 else pose
    out = se3.inverse(body_from_world)
    out[:3, 3] += centre
    return out if np.isfinite(out).all() else None


def _estimate(
    pixels: Floats, xyz: Floats, row_of: Ints, cameras: Sequence[pycolmap.Camera], body_from_cam: Sequence[Floats]
) -> dict[str, Any] | None:
    """What pycolmap finds: for one image its own estimator, for several of a rig the generalised one."""
    options = pycolmap.AbsolutePoseEstimationOptions()
    options.ransac.random_seed, options.ransac.max_num_trials = SEED, MOST_TRIALS
    if len(cameras) == 1:
        return pycolmap.estimate_and_refine_absolute_pose(pixels, xyz, cameras[0], options)
    cams_from_rig = [pycolmap.Rigid3d(np.ascontiguousarray(se3.inverse(pose)[:3])) for pose in body_from_cam]
    rig = row_of.tolist(), cams_from_rig, list(cameras)
    found = pycolmap.estimate_generalized_absolute_pose(pixels, xyz, *rig, options.ransac)
    if found is None:
        return None
    # its last digits hang on where memory lies, those of the refinement on its start alone
    start = pycolmap.Rigid3d(found["rig_from_world"].matrix().astype(np.float32).astype(np.float64))
    refined = pycolmap.refine_generalized_absolute_pose(start, pixels, xyz, found["inlier_mask"], *rig)
    return None if refined is None else found | refined
