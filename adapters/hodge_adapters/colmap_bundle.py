"""Bundle adjustment by pycolmap: poses and points, with cameras and rigs as they are."""

from __future__ import annotations

import numpy as np
import pycolmap

from hodge_adapters.colmap_bodies import Bodies
from hodge_pipeline import se3
from hodge_pipeline.errors import SourceError
from hodge_pipeline.types import Floats, PositionPriors

MAX_ITERATIONS = 100
FUNCTION_TOLERANCE = 1e-7
UNKNOWN = np.nan


def adjust(reconstruction: pycolmap.Reconstruction, bodies: Bodies, priors: PositionPriors | None) -> Floats:
    """Adjust it in place; the standard errors (B, 2) of each body's rotation (rad) and position (units).

    Without priors the first bodies fix the gauge. With priors, in metres, the model keeps to their gauge and scale.
    The errors come from the residuals' own size; those of the bodies that fix the gauge are taken for the others'.
    """
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in reconstruction.reg_image_ids():
        config.add_image(image_id)
    options = _options()
    if priors is not None:
        adjuster = pycolmap.create_pose_prior_bundle_adjuster(
            options, _prior_options(), config, _pose_priors(reconstruction, bodies, priors), reconstruction
        )
        _solve(adjuster)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    if priors is not None:
        options.ceres.solver_options.max_num_iterations = 0
    adjuster = pycolmap.create_default_ceres_bundle_adjuster(options, config, reconstruction)
    summary = _solve(adjuster)
    reconstruction.update_point_3d_errors()
    return _standard_errors(reconstruction, bodies, adjuster, summary)


def _options() -> pycolmap.BundleAdjustmentOptions:
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.refine_focal_length = options.refine_principal_point = options.refine_extra_params = False
    options.refine_sensor_from_rig = False
    solver = options.ceres.solver_options
    solver.max_num_iterations, solver.function_tolerance = MAX_ITERATIONS, FUNCTION_TOLERANCE
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


def _solve(adjuster: pycolmap.BundleAdjuster) -> pycolmap.BundleAdjustmentSummary:
    summary = adjuster.solve()
    if not summary.is_solution_usable():
        raise SourceError(f"bundle adjustment failed ({summary.brief_report()}): the model's points do not fit it")
    return summary


def _standard_errors(
    reconstruction: pycolmap.Reconstruction,
    bodies: Bodies,
    adjuster: pycolmap.CeresBundleAdjuster,
    summary: pycolmap.CeresBundleAdjustmentSummary,
) -> Floats:
    options = pycolmap.BACovarianceOptions()
    options.params = pycolmap.BACovarianceOptionsParams.POSES
    covariance = pycolmap.estimate_ba_covariance(options, reconstruction, adjuster)
    errors = np.full((len(bodies.frame_ids), 2), UNKNOWN)
    if covariance is None:
        return errors
    unit_px = _residual_size(reconstruction, summary)
    for image_id in reconstruction.reg_image_ids():
        image = reconstruction.images[image_id]
        found = covariance.get_cam_cov_from_world(image_id) if image.is_ref_in_frame() else None
        if found is not None and found.shape == (6, 6):
            errors[bodies.frame_ids.index(image.frame_id)] = unit_px * _of_body(found, image.cam_from_world())
    known = np.isfinite(errors).all(axis=1)
    errors[~known] = np.sqrt(np.mean(errors[known] ** 2, axis=0)) if known.any() else UNKNOWN
    return errors


def _residual_size(
    reconstruction: pycolmap.Reconstruction, summary: pycolmap.CeresBundleAdjustmentSummary
) -> float:
    """The standard deviation of a residual in pixels: COLMAP takes it for one."""
    unknowns = 3 * reconstruction.num_points3D() + 6 * reconstruction.num_reg_frames()
    freedom = max(summary.num_residuals - unknowns, 1)
    observations = reconstruction.compute_num_observations()
    mean = float(reconstruction.compute_mean_reprojection_error())
    # the mean distance of a plane Gaussian is σ √(π/2); the residuals are two to an observation
    return mean / np.sqrt(np.pi / 2) * np.sqrt(2 * observations / freedom)


def _of_body(covariance: Floats, cam_from_world: pycolmap.Rigid3d) -> Floats:
    """Standard errors of rotation (rad) and position: roots of the mean of the three variances each.

    COLMAP's tangent is (half the rotation vector, translation) of `cam_from_world`, turned on the left, so the centre
    −Rᵀt moves by −Rᵀ(τ + t^ φ).
    """
    double = np.diag([2.0, 2.0, 2.0, 1.0, 1.0, 1.0])
    full = double @ covariance @ double
    shift = np.hstack([se3.hat(np.asarray(cam_from_world.translation)), np.eye(3)])
    position = np.trace(shift @ full @ shift.T)
    return np.sqrt(np.maximum([np.trace(full[:3, :3]), position], 0.0) / 3)
