"""The relative pose of two images from what both saw, without a look at the poses that a model gives them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hodge_adapters.colmap.pycolmap_import import pycolmap
from hodge_adapters.colmap.records import matrix_of
from hodge_pipeline import se3
from hodge_pipeline.types import Bools, Floats, Ints
from hodge_pipeline.types.arrays import evenly

MAX_ERROR_PX = 4.0
"""COLMAP's default for two views."""
LEAST_ERROR_PX = 0.25
"""A keypoint is never better than this, however well the residuals fit."""
REFINEMENTS = 10
"""Gauss–Newton steps: on Lund door, its pixels noisy, two are enough from a motion 0.01 off."""
INDEPENDENT_POINTS = 50
"""Neighbouring keypoints share the errors of the lens model: more of them than this are no more information."""
LEAST_SCALE_ERROR = 1e-3
"""Relative: of exact points, as of a rendered model, the spread is nothing, and the information would be endless."""
SCALE_PAIRS = 512
"""By so many a median is known to 6 % of the spread."""
START_MATCHES = 500
"""Of many matches, so many evenly serve to begin with; all of them refine it."""
MAX_SCALE_SPREAD = 0.5
"""Relative standard error: a length that may be half as large again is none."""
LEAST_AGREEING, MOST_TRIALS = 0.5, 300
"""Share of the shared points that place both images, and three times the trials that find three of those (1 - 1e-5)."""


@dataclass(frozen=True)
class Sighting:
    """Points that two images share: `pixels_i`, `pixels_j` (N, 2) in COLMAP's pixels, and `xyz (N, 3)` of the model's
    structure, NaN where a point is in none: used for the scale alone, which two images do not give.
    """

    camera_i: pycolmap.Camera
    camera_j: pycolmap.Camera
    pixels_i: Floats
    pixels_j: Floats
    xyz: Floats
    geometry: pycolmap.TwoViewGeometry | None = None


@dataclass(frozen=True)
class Relative:
    """What was found: the motion, its information over (φ, ρ), and how many points agree."""

    i_from_j: Floats
    information: Floats
    inliers: int


def estimate(sighting: Sighting, min_inliers: int, seed: int) -> Relative | str:
    """The relative pose in the model's scale, or the reason why there is none."""
    start = _start(sighting, seed)
    if start is None:
        return "no two-view geometry"
    rays_i, rays_j = _rays(sighting.camera_i, sighting.pixels_i), _rays(sighting.camera_j, sighting.pixels_j)
    seen = np.isfinite(rays_i).all(axis=1) & np.isfinite(rays_j).all(axis=1)
    rays_i, rays_j, xyz = rays_i[seen], rays_j[seen], sighting.xyz[seen]
    pixel = 0.5 / sighting.camera_i.mean_focal_length() + 0.5 / sighting.camera_j.mean_focal_length()
    i_from_j, inlier = _refine(start, rays_i, rays_j, MAX_ERROR_PX * pixel)
    depth_i, depth_j = _depths(i_from_j, rays_i, rays_j)
    inlier &= (depth_i > 0) & (depth_j > 0)
    if inlier.sum() < min_inliers:
        return "too few points agree"
    scale, spread = _scale(depth_j[inlier, None] * rays_j[inlier], xyz[inlier], seed)
    if not spread < MAX_SCALE_SPREAD:
        return "their distance cannot be told"
    residual, jacobian = _sampson(i_from_j, rays_i[inlier], rays_j[inlier])
    sigma = max(float(np.sqrt(np.mean(residual**2))), LEAST_ERROR_PX * pixel)
    jacobian[:, 3:] /= scale
    information = jacobian.T @ jacobian / sigma**2 * min(1.0, INDEPENDENT_POINTS / len(residual))
    along = i_from_j[:3, :3].T @ i_from_j[:3, 3]
    information[3:, 3:] += np.outer(along, along) / (scale * spread) ** 2
    scaled = i_from_j.copy()
    scaled[:3, 3] *= scale
    return Relative(scaled, (information + information.T) / 2, int(inlier.sum()))


def by_structure(sighting: Sighting, min_inliers: int, seed: int) -> tuple[Relative, float] | None:
    """The relative pose of the two images placed each by the shared points as the model has them, and the share of the
    points that agree with both; None where too few do.

    No ambiguity of two views is left, nor of their distance; it is as right as the points are to each other.
    """
    count = len(sighting.pixels_i)
    rows = evenly(count, START_MATCHES)
    if not np.isfinite(sighting.xyz).all():
        return None
    options = pycolmap.AbsolutePoseEstimationOptions()
    options.ransac.random_seed, options.ransac.max_error = seed, MAX_ERROR_PX
    options.ransac.min_inlier_ratio, options.ransac.max_num_trials = LEAST_AGREEING, MOST_TRIALS
    motions, agreeing = [], np.ones(len(rows), bool)
    for camera, pixels in ((sighting.camera_i, sighting.pixels_i), (sighting.camera_j, sighting.pixels_j)):
        found = pycolmap.estimate_and_refine_absolute_pose(pixels[rows], sighting.xyz[rows], camera, options)
        if found is None:
            return None
        motions.append(matrix_of(found["cam_from_world"]))
        agreeing &= np.asarray(found["inlier_mask"], bool)
        if agreeing.mean() < LEAST_AGREEING:
            return None
    share = float(agreeing.mean())
    if share * count < min_inliers or not np.isfinite(motions).all():
        return None
    i_from_world, j_from_world = motions
    used = rows[agreeing]
    variance = 0.0
    pixel = 0.5 / sighting.camera_i.mean_focal_length() + 0.5 / sighting.camera_j.mean_focal_length()
    for camera, pixels, motion in (
        (sighting.camera_i, sighting.pixels_i, i_from_world),
        (sighting.camera_j, sighting.pixels_j, j_from_world),
    ):
        seen = se3.transform(motion, sighting.xyz[used])
        plane = seen[:, :2] / seen[:, 2:]
        variance += 0.5 * float(np.nanmean((plane - np.asarray(camera.cam_from_img(pixels[used]))) ** 2))
    sigma = max(float(np.sqrt(variance)), LEAST_ERROR_PX * pixel)
    # both poses are as uncertain, and together twice
    normal = _pose_normal(se3.transform(j_from_world, sighting.xyz[used]))
    information = 0.5 * normal / sigma**2 * min(1.0, INDEPENDENT_POINTS / len(used))
    return Relative(i_from_world @ se3.inverse(j_from_world), information, round(share * count)), share


def _pose_normal(seen: Floats) -> Floats:
    """JᵀJ (6, 6) of the image of points (N, 3) before a camera, over its motion (φ, ρ)."""
    depth = np.maximum(seen[:, 2], 1e-12)
    slopes = np.zeros((len(seen), 2, 3))
    slopes[:, 0, 0] = slopes[:, 1, 1] = 1.0 / depth
    slopes[:, :, 2] = -seen[:, :2] / depth[:, None] ** 2
    jacobian = (slopes @ se3.by_twist(seen)).reshape(-1, 6)
    return np.asarray(jacobian.T @ jacobian)


def _start(sighting: Sighting, seed: int) -> Floats | None:
    """The motion with a translation of length 1, from the geometry given or from RANSAC on the points."""
    cameras_and_pixels = (sighting.camera_j, sighting.pixels_j, sighting.camera_i, sighting.pixels_i)
    geometry = sighting.geometry
    if geometry is None:
        options = pycolmap.TwoViewGeometryOptions()
        options.ransac.random_seed = seed
        options.ransac.max_error = MAX_ERROR_PX
        count = len(sighting.pixels_i)
        rows = evenly(count, START_MATCHES).astype(np.uint32)
        matches = np.column_stack([rows, rows])
        geometry = pycolmap.estimate_calibrated_two_view_geometry(*cameras_and_pixels, matches, options)
    found = pycolmap.estimate_two_view_geometry_pose(*cameras_and_pixels, geometry)
    motion = geometry.cam2_from_cam1 if found else None
    if motion is None:
        return None
    top = np.asarray(motion.matrix())
    length = np.linalg.norm(top[:, 3])
    if not np.isfinite(top).all() or length < 1e-9:
        return None
    return se3.from_parts(se3.project_to_so3(top[:, :3]), top[:, 3] / length)


def _rays(camera: pycolmap.Camera, pixels: Floats) -> Floats:
    return np.column_stack([np.asarray(camera.cam_from_img(pixels)), np.ones(len(pixels))])


def _sampson(i_from_j: Floats, rays_i: Floats, rays_j: Floats) -> tuple[Floats, Floats]:
    """First-order distances to the epipolar constraint (N,), and their Jacobian (N, 6) over `i_from_j · exp(ξ)`."""
    rotation, translation = i_from_j[:3, :3], i_from_j[:3, 3]
    essential = se3.hat(translation) @ rotation
    line_i, line_j = rays_j @ essential.T, rays_i @ essential
    norm = np.sqrt((line_i[:, :2] ** 2).sum(axis=1) + (line_j[:, :2] ** 2).sum(axis=1)) + 1e-12
    residual = (rays_i * line_i).sum(axis=1) / norm
    turned_j = np.cross(rays_i, translation) @ rotation
    jacobian = np.hstack([np.cross(rays_j, turned_j), np.cross(rays_j, rays_i @ rotation)])
    return residual, jacobian / norm[:, None]


def _refine(i_from_j: Floats, rays_i: Floats, rays_j: Floats, tolerance: float) -> tuple[Floats, Bools]:
    """Gauss–Newton on the points within the tolerance; the translation keeps length 1."""
    for _ in range(REFINEMENTS):
        residual, jacobian = _sampson(i_from_j, rays_i, rays_j)
        inlier = np.abs(residual) < tolerance
        normal = jacobian[inlier].T @ jacobian[inlier]
        gradient = jacobian[inlier].T @ residual[inlier]
        # The length of the translation has no residual: the least-norm step leaves it alone.
        step = -np.linalg.pinv(normal, rcond=1e-9, hermitian=True) @ gradient
        if not np.isfinite(step).all() or np.linalg.norm(step) > 0.5:
            break
        i_from_j = i_from_j @ se3.exp(step)
        i_from_j[:3, 3] /= np.linalg.norm(i_from_j[:3, 3])
        if np.linalg.norm(step) < 1e-10:
            break
    return i_from_j, np.abs(_sampson(i_from_j, rays_i, rays_j)[0]) < tolerance


def _depths(i_from_j: Floats, rays_i: Floats, rays_j: Floats) -> tuple[Floats, Floats]:
    """Depths (N,) along both rays of the point nearest to both; infinite where they are parallel."""
    turned, shift = rays_j @ i_from_j[:3, :3].T, i_from_j[:3, 3]
    aa, bb, ab = (rays_i**2).sum(axis=1), (turned**2).sum(axis=1), (rays_i * turned).sum(axis=1)
    a_shift, b_shift = rays_i @ shift, turned @ shift
    determinant = aa * bb - ab**2
    with np.errstate(divide="ignore", invalid="ignore"):
        depth_i = (bb * a_shift - ab * b_shift) / determinant
        depth_j = (ab * a_shift - aa * b_shift) / determinant
    bad = determinant < 1e-12 * aa * bb
    return np.where(bad, -1.0, depth_i), np.where(bad, -1.0, depth_j)


def _scale(triangulated: Floats, xyz: Floats, seed: int) -> tuple[float, float]:
    """Model units per triangulated unit, and its relative standard error, by distances between the points."""
    known = np.flatnonzero(np.isfinite(xyz).all(axis=1))
    if len(known) < 8:
        return 1.0, np.inf
    rng = np.random.default_rng(seed)
    a: Ints = rng.choice(known, SCALE_PAIRS)
    b: Ints = rng.choice(known, SCALE_PAIRS)
    here = np.linalg.norm(triangulated[a] - triangulated[b], axis=1)
    there = np.linalg.norm(xyz[a] - xyz[b], axis=1)
    useful = (here > 0) & (there > 0)
    if useful.sum() < 8:
        return 1.0, np.inf
    logarithms = np.log(there[useful] / here[useful])
    middle = np.median(logarithms)
    spread = 1.4826 * np.median(np.abs(logarithms - middle))
    return float(np.exp(middle)), max(float(spread) / np.sqrt(min(len(known), INDEPENDENT_POINTS)), LEAST_SCALE_ERROR)
