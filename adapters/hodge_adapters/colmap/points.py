"""Points where the rays of their tracks meet, for all tracks at once."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hodge_adapters.colmap.cameras import colmap_camera
from hodge_adapters.colmap.pycolmap_import import pycolmap
from hodge_adapters.colmap.records import NO_POINT, Model, Points
from hodge_pipeline import se3
from hodge_pipeline.types import Bools, Floats, Ints

LEAST_PARALLAX = 1e-4
"""Smallest eigenvalue over the number of rays, below which they are parallel: an angle of about a degree."""

NO_ERROR = -1.0
"""COLMAP's mark of a point whose error is not known; its own mean leaves such points out."""
SENTINEL_PX = 1e100
"""pycolmap takes the root of the largest double, 1e154 px, for an observation behind a camera; a point's error is the
mean of its track's. No projection reaches this."""
LEAST_CAP_PX = 4.0
"""COLMAP's own limit (`filter_max_reproj_error`): beyond it an observation is wrong, and how far off tells no more."""
CAP_MEDIANS = 3.0
"""Of the median: where poses are disturbed by more than the limit, most errors still stay below the cap."""


def points_of_rays(model: Model, world_from_cam: Floats) -> Floats:
    """Positions (P, 3) of the points with the images at the poses (N, 4, 4).

    Each is where it was, or where its images carry it along, or the point nearest to its rays: whichever is nearest to
    the observations. Rays that are parallel have no nearest point.
    """
    points = model.points
    count = len(points.ids)
    if not count:
        return np.zeros((0, 3))
    image, centre, ray, owner = _rays(model, world_from_cam)
    moves = world_from_cam @ se3.inverse(model.world_from_cam)
    carried = _mean(se3.transform(moves[image], points.xyz[owner][:, None])[:, 0], owner, count)
    met = nearest_to_rays(centre, ray, owner, count)
    choices = np.stack([points.xyz, carried, np.where(np.isnan(met), carried, met)])
    best = np.argmin([_off(xyz, centre, ray, owner) for xyz in choices], axis=0)
    return np.asarray(choices[best, np.arange(count)])


def nearest_to_rays(centre: Floats, ray: Floats, owner: Ints, count: int) -> Floats:
    """The point (count, 3) nearest to the rays that it owns (N,), from these centres (N, 3) along these unit vectors
    (N, 3); NaN where they are parallel.
    """
    across = np.eye(3) - ray[:, :, None] * ray[:, None, :]
    normal = _sum(across.reshape(-1, 9), owner, count).reshape(-1, 3, 3)
    right = _sum(np.einsum("nij,nj->ni", across, centre), owner, count)
    fixed = np.linalg.eigvalsh(normal)[:, 0] > LEAST_PARALLAX * np.maximum(np.bincount(owner, minlength=count), 1)
    normal[~fixed] = np.eye(3)
    return np.where(fixed[:, None], np.linalg.solve(normal, right[:, :, None])[:, :, 0], np.nan)


def parallaxes(model: Model) -> Floats:
    """The angle (P,) in degrees between the rays to each point: twice that of the widest to their mean."""
    centres = model.world_from_cam[:, :3, 3]
    points, owner = model.points, model.points.owners
    ray = points.xyz[owner] - centres[model.image_rows]
    ray = ray / np.maximum(np.linalg.norm(ray, axis=1, keepdims=True), 1e-300)
    mean = _sum(ray, owner, len(points.ids))
    mean /= np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-300)
    widest = np.zeros(len(points.ids))
    np.maximum.at(widest, owner, np.linalg.norm(ray - mean[owner], axis=1))
    return np.asarray(np.degrees(4.0 * np.arcsin(np.minimum(widest / 2.0, 1.0))))


def _off(xyz: Floats, centre: Floats, ray: Floats, owner: Ints) -> Floats:
    """The mean of the sines between the rays and the directions to the points (P,); 1 for one that is behind.

    No squares: one image at a wrong pose must not draw a point away from all others.
    """
    to_point = xyz[owner] - centre
    length = np.maximum(np.linalg.norm(to_point, axis=1), 1e-300)
    cosine = np.einsum("ni,ni->n", ray, to_point) / length
    sine = np.linalg.norm(np.cross(ray, to_point), axis=1) / length
    return _mean(np.where(cosine > 0, sine, 1.0)[:, None], owner, len(xyz))[:, 0]


def _rays(model: Model, world_from_cam: Floats) -> tuple[Ints, Floats, Floats, Ints]:
    """For each observation of a track: the row of its image, the camera's centre, the unit ray, its point's row."""
    points = model.points
    row, owner = model.image_rows, points.owners
    rays = np.zeros((len(row), 3))
    for image, here in zip(model.images, model.entries, strict=True):
        if len(here):
            camera = colmap_camera(model.cameras[image.camera_id])
            plane = np.asarray(camera.cam_from_img(image.pixels[points.columns[here]]))
            rays[here] = np.column_stack([plane, np.ones(len(plane))])
    usable = np.isfinite(rays).all(axis=1)
    row, owner, rays = row[usable], owner[usable], rays[usable]
    rays = np.einsum("nij,nj->ni", world_from_cam[row, :3, :3], rays)
    return row, world_from_cam[row, :3, 3], rays / np.linalg.norm(rays, axis=1, keepdims=True), owner


def _sum(values: Floats, owner: Ints, count: int) -> Floats:
    return np.stack([np.bincount(owner, column, minlength=count) for column in values.T], axis=1).astype(float)


def _mean(values: Floats, owner: Ints, count: int) -> Floats:
    return _sum(values, owner, count) / np.maximum(np.bincount(owner, minlength=count), 1)[:, None]


def thinned_points(model: Model, most_seen: int) -> Bools:
    """Which points (P,) stay where each image keeps so many of its own: those first in one random order of all, so that
    images keep the same ones.
    """
    points = model.points
    place = np.random.default_rng(0).permutation(len(points.ids))
    kept = np.zeros(len(points.ids), bool)
    for here in model.entries:
        own = np.unique(points.owners[here])
        kept[own[np.argsort(place[own])[:most_seen]]] = True
    return kept


def with_points(model: Model, kept: Bools) -> Model:
    """The model with these of its points (P,) alone."""
    points = model.points
    entries, lengths = kept[points.owners], np.diff(points.offsets)[kept]
    left = Points(
        ids=points.ids[kept],
        xyz=points.xyz[kept],
        offsets=np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64),
        image_ids=points.image_ids[entries],
        columns=points.columns[entries],
    )
    images = [
        replace(image, point_ids=np.where(left.rows_of(image.point_ids) >= 0, image.point_ids, NO_POINT))
        for image in model.images
    ]
    return replace(model, images=images, points=left)


def error_cap(errors_px: Floats) -> float:
    """The error beyond which an observation of these (N,) is wrong; those behind a camera do not count."""
    seen = errors_px[np.isfinite(errors_px)]
    return max(LEAST_CAP_PX, CAP_MEDIANS * float(np.median(seen))) if len(seen) else LEAST_CAP_PX


def reprojection_errors(model: Model) -> Floats:
    """The error (T,) in pixels of each entry of a track; infinite where the point lies behind the camera, so that the
    camera cannot project it.
    """
    points, owner = model.points, model.points.owners
    errors_px = np.full(len(owner), np.inf)
    for image, here in zip(model.images, model.entries, strict=True):
        if not len(here):
            continue
        in_cam = se3.transform(se3.inverse(image.world_from_cam), points.xyz[owner[here]])
        projected = np.asarray(colmap_camera(model.cameras[image.camera_id]).img_from_cam(in_cam))
        distance_px = np.linalg.norm(projected - image.pixels[points.columns[here]], axis=1)
        errors_px[here] = np.where(np.isfinite(distance_px), distance_px, np.inf)
    return errors_px


def update_errors(reconstruction: pycolmap.Reconstruction) -> None:
    """Set the error of every point in place; `NO_ERROR` where one of its cameras has it behind."""
    reconstruction.update_point_3d_errors()
    for point in reconstruction.points3D.values():
        if not point.error < SENTINEL_PX:
            point.error = NO_ERROR
