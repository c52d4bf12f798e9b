"""Bundle adjustment by pycolmap: poses and points; intrinsics, or the rigs' own poses, where that is asked for."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import replace
from typing import Literal, NamedTuple, TypeAlias

import numpy as np

from hodge_adapters.colmap.bodies import Bodies
from hodge_adapters.colmap.pycolmap_import import pycolmap
from hodge_pipeline.errors import SourceError
from hodge_pipeline.types import PositionPriors

Refine: TypeAlias = Literal["none", "rig", "focal", "all"]
"""What is adjusted beside poses and points: nothing; where rigs hold their cameras; of each camera its focal lengths;
these, its principal point and its distortion."""
ROUGH = 1e-3
"""Relative change of the cost at which a rough adjustment ends: it tells a gain of some per cent."""
CONVERGED = 1e-12
"""Relative change of the cost at which others end: of a million residuals it is a millionth of what one contributes.
COLMAP goes on until the gradient vanishes, among rounding errors for up to half of its steps."""
POINTS_CONVERGED = 1e-6
"""The same where points alone move: none pulls another, so no long valley is left to go along where the cost falls as
slowly, and it is a hundredth of what tells two costs apart."""
WIDE = 1e8
"""Radius of the first trust region near an optimum: what COLMAP's own 1e4 grows to in eight good steps."""


class Adjustment(NamedTuple):
    """The points whose place is not adjusted to their whole track, and whether it ended before the limit of steps."""

    loose: set[int]
    converged: bool


def adjust(
    reconstruction: pycolmap.Reconstruction,
    behind: Sequence[tuple[int, int]],
    bodies: Bodies,
    priors: PositionPriors | None,
    *,
    move_bodies: bool,
    refine: Refine = "none",
    robust: bool,
    roughly: bool = False,
    near_optimum: bool,
) -> Adjustment:
    """Adjust it in place with COLMAP's own options; the points alone where bodies are not to move.

    As in COLMAP, observations (image, keypoint) of points `behind` their camera take no part. Without priors the gauge
    is that of two images; with them the model keeps to theirs. `robust`: with a Cauchy loss of one pixel, for tracks
    that contradict each other. `roughly`: to a step that gains less than `ROUGH` of the cost. `near_optimum`: with
    whole Gauss-Newton steps from the first, of which few suffice there. Raises `SourceError` where the adjustment
    fails.
    """
    loose = {key for key, point in reconstruction.points3D.items() if point.track.length() < 2}
    is_whole = not loose and not behind
    part = reconstruction if is_whole else pycolmap.Reconstruction(reconstruction)
    poses = {frame_id: copy(reconstruction.frames[frame_id].rig_from_world) for frame_id in bodies.frame_ids}
    rigs = _sensors_from_rigs(reconstruction)
    for key in loose:  # they tell nothing; real models have such, and COLMAP refuses to adjust a model with them
        part.delete_point3D(key)
    for image_id, column in behind:
        seen = part.images[image_id].points2D[column]
        if seen.has_point3D():
            loose.add(seen.point3D_id)
            part.delete_observation(image_id, column)
    if not part.num_points3D():
        raise SourceError("no point was seen by two images: nothing ties the poses: triangulate points first")
    options = _options(refine)
    least_gain = CONVERGED if move_bodies else POINTS_CONVERGED
    options.ceres.solver_options.function_tolerance = ROUGH if roughly else least_gain
    if near_optimum:
        options.ceres.solver_options.initial_trust_region_radius = WIDE
    # far from the origin (UTM) and in large units it would stop early: its tolerances are absolute
    normal_from_world = part.normalize(fixed_scale=priors is not None)
    if priors is not None:
        priors = replace(priors, positions=priors.positions + normal_from_world.translation)
    converged = _solve(_adjuster(part, bodies, priors, move_bodies, options, robust))
    part.transform(normal_from_world.inverse())
    # what was held is bit for bit what it was
    for frame_id, pose in poses.items():
        reconstruction.frames[frame_id].rig_from_world = part.frames[frame_id].rig_from_world if move_bodies else pose
    for (rig_id, sensor), pose in (_sensors_from_rigs(part) if refine == "rig" else rigs).items():
        reconstruction.rigs[rig_id].set_sensor_from_rig(sensor, pose)
    if not is_whole:
        for camera_id, camera in part.cameras.items():
            reconstruction.cameras[camera_id].params = camera.params
        points = reconstruction.points3D
        for key, point in part.points3D.items():
            points[key].xyz = point.xyz
    return Adjustment(loose, converged)


def _sensors_from_rigs(
    reconstruction: pycolmap.Reconstruction,
) -> dict[tuple[int, pycolmap.sensor_t], pycolmap.Rigid3d]:
    """Copies of where each rig holds its other sensors, as far as that is known."""
    return {
        (rig_id, sensor): copy(sensor_from_rig)
        for rig_id, rig in reconstruction.rigs.items()
        for sensor, sensor_from_rig in rig.non_ref_sensors.items()
        if sensor_from_rig is not None
    }


def _adjuster(
    reconstruction: pycolmap.Reconstruction,
    bodies: Bodies,
    priors: PositionPriors | None,
    move_bodies: bool,
    options: pycolmap.BundleAdjustmentOptions,
    robust: bool,
) -> pycolmap.BundleAdjuster:
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in reconstruction.reg_image_ids():
        config.add_image(image_id)
    if not move_bodies:
        for frame_id in bodies.frame_ids:
            config.set_constant_rig_from_world_pose(frame_id)
    elif priors is None:
        config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    if robust:
        options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    if priors is None:
        return pycolmap.create_default_bundle_adjuster(options, config, reconstruction)
    # what tracks and priors make of each other must not hang on a few bad tracks
    if not robust:
        options.ceres.loss_function_type = pycolmap.LossFunctionType.SOFT_L1
    known = _pose_priors(reconstruction, bodies, priors)
    return pycolmap.create_pose_prior_bundle_adjuster(options, _prior_options(), config, known, reconstruction)


def _options(refine: Refine) -> pycolmap.BundleAdjustmentOptions:
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.ceres.solver_options.num_threads = 1  # of several the order of sums, and so the result, is left to chance
    options.refine_focal_length = refine in ("focal", "all")
    options.refine_principal_point = options.refine_extra_params = refine == "all"
    options.refine_sensor_from_rig = refine == "rig"
    return options


def _prior_options() -> pycolmap.PosePriorBundleAdjustmentOptions:
    options = pycolmap.PosePriorBundleAdjustmentOptions()
    options.alignment_ransac.random_seed = 0
    options.ceres.prior_position_loss_function_type = pycolmap.LossFunctionType.CAUCHY
    return options


def _pose_priors(
    reconstruction: pycolmap.Reconstruction, bodies: Bodies, priors: PositionPriors
) -> list[pycolmap.PosePrior]:
    """A prior for one image of each body that has one: the image that the rig is reckoned from."""
    chosen: dict[int, pycolmap.Image] = {}
    for image_id in reconstruction.reg_image_ids():
        image = reconstruction.images[image_id]
        if image.is_ref_in_frame():
            chosen[image.frame_id] = image
    out = []
    for row, frame_id in enumerate(bodies.frame_ids):
        known = np.isfinite(priors.positions[row]).all() and np.isfinite(priors.covariances[row]).all()
        if known and frame_id in chosen:
            prior = pycolmap.PosePrior()
            prior.position, prior.position_covariance = priors.positions[row], priors.covariances[row]
            prior.coordinate_system = pycolmap.PosePriorCoordinateSystem.CARTESIAN
            prior.corr_data_id = chosen[frame_id].data_id
            out.append(prior)
    return out


def _solve(adjuster: pycolmap.BundleAdjuster) -> bool:
    """Whether it converged."""
    try:
        summary = adjuster.solve()
    except (ValueError, RuntimeError, IndexError) as error:  # what its C++ checks raise
        raise SourceError(f"bundle adjustment failed ({error}): does COLMAP itself open the model?") from error
    if not summary.is_solution_usable():
        raise SourceError(f"bundle adjustment failed ({summary.brief_report()}): the model's points do not fit it")
    return bool(summary.termination_type == pycolmap.BundleAdjustmentTerminationType.CONVERGENCE)
