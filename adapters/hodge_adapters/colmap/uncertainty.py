"""How well the tracks of a COLMAP model fix its bodies: the covariance of bundle adjustment, poses alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array

from hodge_adapters.colmap.bodies import Bodies
from hodge_adapters.colmap.cameras import colmap_camera
from hodge_adapters.colmap.points import error_cap
from hodge_adapters.colmap.records import Model
from hodge_pipeline import se3
from hodge_pipeline.types import Bools, Floats, Ints

GAUGE = 7
"""Turn, shift and size of the whole, which no track tells."""
MOST_BODIES_JOINTLY = 300
"""Above it the joint covariance (6 B)² costs too much: each body is then taken given all others, which is too sure."""
MOST_POINTS_AT_ONCE = 16384
"""Whose part of the joint normal matrix is in memory at once."""
STEP = 1e-6
LEAST_SEEN = 3
"""Observations that fix a pose."""


@dataclass(frozen=True)
class _Rows:
    """Residuals (M, 2), their derivatives by the body's ξ (M, 2, 6) and the point (M, 2, 3), and whose they are."""

    residual: Floats
    by_body: Floats
    by_point: Floats
    body: Ints
    point: Ints

    def of(self, seen: Bools) -> _Rows:
        """The rows of these bodies (B,), which are then numbered without the others."""
        at = seen[self.body]
        body = (np.cumsum(seen) - 1)[self.body[at]]
        return _Rows(self.residual[at], self.by_body[at], self.by_point[at], body, self.point[at])


def standard_errors(model: Model, bodies: Bodies) -> Floats:
    """Standard errors (B, 2) of each body's rotation (rad) and position (units): roots of the mean variance of 3 axes.

    From the size of the residuals, wrong observations left out (see `error_cap`); in the gauge in which the bodies as a
    whole stay where they are. NaN without tracks, and of a body with fewer than `LEAST_SEEN` observations, which takes
    no part: what is free beside the gauge would be mistaken for it.
    """
    rows = _rows(model, bodies)
    out = np.full((len(bodies.frame_ids), 2), np.nan)
    seen = np.bincount(rows.body, minlength=len(out)) >= LEAST_SEEN
    rows, count = rows.of(seen), int(seen.sum())
    points = np.unique(rows.point)
    freedom = rows.residual.size - 6 * count - 3 * len(points) + GAUGE
    if freedom <= 0 or not len(points):
        return out
    variance = float((rows.residual**2).sum()) / freedom
    schur = _schur(rows, count, joint=count <= MOST_BODIES_JOINTLY)
    if count <= MOST_BODIES_JOINTLY:
        blocks = _inverse_without_gauge(schur).reshape(count, 6, count, 6)[np.arange(count), :, np.arange(count)]
    else:
        blocks = np.asarray(np.linalg.pinv(schur, hermitian=True), np.float64)
    variances = variance * np.diagonal(blocks, axis1=1, axis2=2).reshape(count, 2, 3).mean(axis=2)
    out[seen] = np.sqrt(np.maximum(variances, 0.0))
    return out


def _schur(rows: _Rows, count: int, joint: bool) -> Floats:
    """The normal matrix of the bodies with the points eliminated: (6 B, 6 B), or its blocks (B, 6, 6) alone."""
    size = int(rows.point.max(initial=-1)) + 1
    normal = np.zeros((count, 6, 6))
    np.add.at(normal, rows.body, np.swapaxes(rows.by_body, 1, 2) @ rows.by_body)
    of_point = np.zeros((size, 3, 3))
    np.add.at(of_point, rows.point, np.swapaxes(rows.by_point, 1, 2) @ rows.by_point)
    of_point += 1e-9 * np.trace(of_point, axis1=1, axis2=2)[:, None, None] * np.eye(3) + 1e-300 * np.eye(3)
    root = np.linalg.cholesky(np.linalg.inv(of_point))
    mixed = np.swapaxes(rows.by_body, 1, 2) @ rows.by_point @ root[rows.point]
    if not joint:
        np.add.at(normal, rows.body, -mixed @ np.swapaxes(mixed, 1, 2))
        return normal
    blocks = np.zeros((count, 6, count, 6))
    blocks[np.arange(count), :, np.arange(count)] = normal
    out = blocks.reshape(6 * count, 6 * count)
    for start in range(0, size, MOST_POINTS_AT_ONCE):
        at = np.flatnonzero((rows.point >= start) & (rows.point < start + MOST_POINTS_AT_ONCE))
        row = np.broadcast_to((6 * rows.body[at, None] + np.arange(6))[:, :, None], (len(at), 6, 3))
        column = np.broadcast_to((3 * (rows.point[at, None] - start) + np.arange(3))[:, None], row.shape)
        shape = 6 * count, 3 * MOST_POINTS_AT_ONCE
        part = csr_array((mixed[at].ravel(), (row.ravel(), column.ravel())), shape)
        out -= (part @ part.T).toarray()
    return out


def _inverse_without_gauge(matrix: Floats) -> Floats:
    """The pseudo-inverse without the directions that are free; lengths count as angles, which suits unit scenes."""
    values, vectors = np.linalg.eigh((matrix + matrix.T) / 2)
    kept = np.arange(len(values)) >= GAUGE
    kept &= values > 1e-12 * values[-1]
    return np.asarray((vectors[:, kept] / values[kept]) @ vectors[:, kept].T)


def _rows(model: Model, bodies: Bodies) -> _Rows:
    points = model.points
    owner = points.owners
    parts = []
    for number, (image, here) in enumerate(zip(model.images, model.entries, strict=True)):
        camera = colmap_camera(model.cameras[image.camera_id])
        body = bodies.body_of_image[number]
        body_from_world, cam_from_body = (
            se3.inverse(bodies.world_from_body[body]),
            se3.inverse(bodies.body_from_cam[number]),
        )
        in_body = se3.transform(body_from_world, points.xyz[owner[here]])
        in_cam = se3.transform(cam_from_body, in_body)

        def project(xyz: Floats, camera: object = camera) -> Floats:
            return np.asarray(camera.img_from_cam(xyz))  # type: ignore[attr-defined]

        step = STEP * np.maximum(np.abs(in_cam[:, 2:]), 1e-12)
        slopes = [(project(in_cam + step * axis) - project(in_cam - step * axis)) / (2 * step) for axis in np.eye(3)]
        by_body_point = np.stack(slopes, axis=2) @ cam_from_body[:3, :3]
        # a body at T exp(ξ) sees the point at x − φ × x − ρ
        motion = np.concatenate([se3.hat(in_body), np.broadcast_to(-np.eye(3), (len(here), 3, 3))], axis=2)
        residual = project(in_cam) - image.pixels[points.columns[here]]
        good = np.isfinite(residual).all(axis=1) & np.isfinite(by_body_point).all(axis=(1, 2))
        rows = (
            residual,
            by_body_point @ motion,
            by_body_point @ body_from_world[:3, :3],
            np.full(len(here), body),
            owner[here],
        )
        parts.append([column[good] for column in rows])
    columns = [np.concatenate(column) for column in zip(*parts, strict=True)]
    errors_px = np.linalg.norm(columns[0], axis=1)
    right = errors_px <= error_cap(errors_px)
    return _Rows(*(column[right] for column in columns))
