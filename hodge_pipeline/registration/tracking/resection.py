"""The pose of a camera from known points: their pixels and, where the depth image has them, their depths.

Pixel and depth errors are apart here: what a rolling shutter, blur and optical flow do to a pixel has nothing to do
with what the depth camera does to a distance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.registration.pixels import DEPTH_SIGMAS, PIXEL_SIGMA, depth_sigma, project
from hodge_pipeline.types import Bools, Camera, Floats

GATE_PX = 4.0
"""Reprojection error in pixels of an inlier, at most; depths are gated at as many sigmas."""
ANNEALED = (8.0, 4.0, 2.0, 1.0, 1.0, 1.0, 1.0)
"""Cauchy scale of each Gauss-Newton step, coarse to fine: a wrong start may be off by tens of pixels."""
FEWEST = 12
"""Inliers that a pose needs: three times the minimal four."""


@dataclass(frozen=True)
class Resection:
    """`known_from_cam (4, 4)`, its information (6, 6) over `known_from_cam exp(ξ)`, and which points (n,) agree."""

    known_from_cam: Floats
    information: Floats
    inliers: Bools


def resect(
    points: Floats, seen: Floats, camera: Camera, known_from_cam: Floats, unit_m: float = 1.0
) -> Resection | None:
    """The pose that sees points (n, 3) at `seen (n, 3)`, columns u, v, z (NaN: no depth there), from a guess.

    None with fewer than 12 inliers. `unit_m` is the number of length units per metre.
    """
    points, seen = points / unit_m, seen / [1.0, 1.0, unit_m]
    pose = se3.rescaled(known_from_cam, 1 / unit_m)
    for scale in ANNEALED:
        found = _step(points, seen, camera, pose, scale)
        if found is None:
            return None
        step, information = found
        pose = pose @ se3.exp(step)
        if scale == 1.0 and np.abs(step).max() < 1e-6:
            break
    inliers = _inliers(points, seen, camera, pose)
    if inliers.sum() < FEWEST:
        return None
    return Resection(se3.rescaled(pose, unit_m), se3.rescaled_information(information, unit_m), inliers)


def robust_cost(points: Floats, seen: Floats, camera: Camera, known_from_cam: Floats, unit_m: float = 1.0) -> float:
    """Cauchy cost, at scale 1, of the residuals over their sigmas; inputs as of `resect`. A point behind the camera
    costs as one at the gate.
    """
    pose = se3.rescaled(known_from_cam, 1 / unit_m)
    in_cam, residual = _residuals(points / unit_m, seen / [1.0, 1.0, unit_m], camera, pose)
    squares = (_white(in_cam, residual) ** 2).sum(axis=1)
    return float(1.5 * np.log1p(np.nan_to_num(squares, nan=(GATE_PX / PIXEL_SIGMA) ** 2) / 3).sum())


def _white(in_cam: Floats, residual: Floats) -> Floats:
    """Residuals (n, 3) over their standard deviations."""
    pixel = np.full(len(in_cam), PIXEL_SIGMA)
    return np.asarray(residual / np.stack([pixel, pixel, DEPTH_SIGMAS * depth_sigma(in_cam[:, 2])], axis=1))


def _residuals(points: Floats, seen: Floats, camera: Camera, pose: Floats) -> tuple[Floats, Floats]:
    """Points (n, 3) in the camera, and residuals u, v, z (n, 3): z is 0 without depth, all NaN behind the camera."""
    in_cam = (points - pose[:3, 3]) @ pose[:3, :3]
    residual = seen - project(in_cam, camera)
    residual[np.isnan(seen[:, 2]), 2] = 0.0
    return in_cam, residual


def _inliers(points: Floats, seen: Floats, camera: Camera, pose: Floats) -> Bools:
    in_cam, residual = _residuals(points, seen, camera, pose)
    near = np.hypot(residual[:, 0], residual[:, 1]) < GATE_PX
    sigma_z = DEPTH_SIGMAS * depth_sigma(in_cam[:, 2])
    return np.asarray(near & (np.abs(residual[:, 2]) < GATE_PX / PIXEL_SIGMA * sigma_z))


def focal_evidence(
    points: Floats, seen: Floats, camera: Camera, known_from_cam: Floats, unit_m: float = 1.0
) -> tuple[float, float]:
    """Gradient −½ dχ²/d log f and information on the logarithm of the focal length, the pose marginalised out.

    Inputs as of `resect`, at the pose of least cost. `points` are back-projected pixels of a camera with the same f.
    """
    points, seen = points / unit_m, seen / [1.0, 1.0, unit_m]
    found = _linearised(points, seen, camera, se3.rescaled(known_from_cam, 1 / unit_m), 1.0)
    if found is None:
        return 0.0, 0.0
    jacobian, white = found
    *of_pose, of_focal = jacobian
    basis = np.linalg.qr(np.array(of_pose).T)[0]
    of_focal = of_focal - basis @ (basis.T @ of_focal)
    return float(of_focal @ white), float(of_focal @ of_focal)


def _step(points: Floats, seen: Floats, camera: Camera, pose: Floats, scale: float) -> tuple[Floats, Floats] | None:
    """The Gauss-Newton step ξ (6,) and the information (6, 6), with Cauchy weights."""
    found = _linearised(points, seen, camera, pose, scale)
    if found is None:
        return None
    jacobian, white = found[0][:6], found[1]
    information = jacobian @ jacobian.T
    damped = information + 1e-9 * np.trace(information) * np.eye(6)
    return np.linalg.solve(damped, jacobian @ white), information


def _linearised(
    points: Floats, seen: Floats, camera: Camera, pose: Floats, scale: float
) -> tuple[Floats, Floats] | None:
    """Jacobian (7, 3n) by ξ and log f, and residuals (3n,), over their sigmas and with Cauchy weights."""
    in_cam, residual = _residuals(points, seen, camera, pose)
    usable = np.isfinite(residual).all(axis=1)
    if usable.sum() < FEWEST:
        return None
    in_cam, residual = in_cam[usable], residual[usable]
    x, y, z = in_cam.T
    white = _white(in_cam, residual)
    weight = 1 / (1 + (white**2).sum(axis=1) / (3 * scale**2))
    no_depth = np.isnan(seen[usable, 2])
    sigma_z = np.where(no_depth, np.inf, DEPTH_SIGMAS * depth_sigma(z))
    gain = np.sqrt(weight) / [PIXEL_SIGMA / camera.fx * z, PIXEL_SIGMA / camera.fy * z, sigma_z]
    u, v, one, none = x / z, y / z, np.ones(len(z)), np.zeros(len(z))
    narrowed = -points[usable] * [1.0, 1.0, 0.0] @ pose[:3, :3]
    # by ξ = (φ, ρ) a point in the camera moves by −(φ × p + ρ); by log f so that its pixels in both cameras are kept
    moved = [
        [u * y, z + v * y, -y],
        [-z - u * x, -v * x, x],
        [y, -x, none],
        [-one, none, none],
        [none, -one, none],
        [u, v, -one],
        [narrowed[:, 0] - u * narrowed[:, 2] + x, narrowed[:, 1] - v * narrowed[:, 2] + y, narrowed[:, 2]],
    ]
    return (np.array(moved) * gain).reshape(7, -1), (white * np.sqrt(weight)[:, None]).T.ravel()
