"""Points where the rays of their tracks meet, for all tracks at once."""

from __future__ import annotations

import numpy as np

from hodge_adapters.colmap_cameras import colmap_camera
from hodge_adapters.colmap_records import Model
from hodge_pipeline import se3
from hodge_pipeline.types import Floats, Ints

LEAST_PARALLAX = 1e-4
"""Smallest eigenvalue over the number of rays, below which they are parallel: an angle of about a degree."""


def points_of_rays(model: Model, world_from_cam: Floats) -> Floats:
    """Positions (P, 3) of the points with the images at the poses (N, 4, 4).

    Each is the point nearest to its rays, or where its images carry it along, whichever is nearer to the observations;
    carried along where rays are parallel or meet behind a camera.
    """
    points = model.points
    count = len(points.ids)
    if not count:
        return np.zeros((0, 3))
    image, centre, ray, owner = _rays(model, world_from_cam)
    old = np.array([one.world_from_cam for one in model.images])
    moves = world_from_cam @ se3.inverse(old)
    carried = _mean(se3.transform(moves[image], points.xyz[owner][:, None])[:, 0], owner, count)
    across = np.eye(3) - ray[:, :, None] * ray[:, None, :]
    normal = _sum(across.reshape(-1, 9), owner, count).reshape(-1, 3, 3)
    right = _sum(np.einsum("nij,nj->ni", across, centre), owner, count)
    fixed = np.linalg.eigvalsh(normal)[:, 0] > LEAST_PARALLAX * np.maximum(np.bincount(owner, minlength=count), 1)
    normal[~fixed] = np.eye(3)
    met = np.asarray(np.linalg.solve(normal, right[:, :, None])[:, :, 0], np.float64)
    better = _off(met, centre, ray, owner) < _off(carried, centre, ray, owner)
    return np.where((fixed & better)[:, None], met, carried)


def _off(xyz: Floats, centre: Floats, ray: Floats, owner: Ints) -> Floats:
    """The mean square of the sines between the rays and the directions to the points (P,); 1 for one that is behind."""
    to_point = xyz[owner] - centre
    length = np.maximum(np.linalg.norm(to_point, axis=1), 1e-300)
    cosine = np.einsum("ni,ni->n", ray, to_point) / length
    sine = np.linalg.norm(np.cross(ray, to_point), axis=1) / length
    return _mean(np.where(cosine > 0, sine**2, 1.0)[:, None], owner, len(xyz))[:, 0]


def _rays(model: Model, world_from_cam: Floats) -> tuple[Ints, Floats, Floats, Ints]:
    """For each observation of a track: the row of its image, the camera's centre, the unit ray, its point's row."""
    points = model.points
    row_of = {image.image_id: row for row, image in enumerate(model.images)}
    row = np.array([row_of[image_id] for image_id in points.image_ids.tolist()], np.int64)
    owner = np.repeat(np.arange(len(points.ids)), np.diff(points.offsets))
    rays = np.zeros((len(row), 3))
    for number, image in enumerate(model.images):
        here = np.flatnonzero(row == number)
        if len(here):
            camera = colmap_camera(model.cameras[image.camera_id])
            plane = np.asarray(camera.cam_from_img(image.pixels[points.columns[here]]))
            rays[here] = np.column_stack([plane, np.ones(len(plane))])
    usable = np.isfinite(rays).all(axis=1)
    row, owner, rays = row[usable], owner[usable], rays[usable]
    rays = np.einsum("nij,nj->ni", world_from_cam[row, :3, :3], rays)
    return row, world_from_cam[row, :3, 3], rays / np.linalg.norm(rays, axis=1, keepdims=True), owner


def _sum(values: Floats, owner: Ints, count: int) -> Floats:
    return np.stack([np.bincount(owner, column, minlength=count) for column in values.T], axis=1)


def _mean(values: Floats, owner: Ints, count: int) -> Floats:
    return _sum(values, owner, count) / np.maximum(np.bincount(owner, minlength=count), 1)[:, None]
