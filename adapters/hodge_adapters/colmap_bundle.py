"""Bundle adjustment by pycolmap: poses and points, with cameras and rigs as they are."""

from __future__ import annotations

import numpy as np
import pycolmap

from hodge_adapters.colmap_bodies import Bodies
from hodge_pipeline.errors import SourceError
from hodge_pipeline.types import PositionPriors

MAX_ITERATIONS = 100
FUNCTION_TOLERANCE = 1e-7


def adjust(reconstruction: pycolmap.Reconstruction, bodies: Bodies, priors: PositionPriors | None) -> None:
    """Adjust it in place. Without priors the gauge is that of two images; with them the model keeps to theirs.

    Raises `SourceError` where the adjustment fails.
    """
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in reconstruction.reg_image_ids():
        config.add_image(image_id)
    if priors is None:
        config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
        _solve(pycolmap.create_default_bundle_adjuster(_options(), config, reconstruction))
    else:
        known = _pose_priors(reconstruction, bodies, priors)
        _solve(pycolmap.create_pose_prior_bundle_adjuster(_options(), _prior_options(), config, known, reconstruction))
    reconstruction.update_point_3d_errors()


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


def _solve(adjuster: pycolmap.BundleAdjuster) -> None:
    summary = adjuster.solve()
    if not summary.is_solution_usable():
        raise SourceError(f"bundle adjustment failed ({summary.brief_report()}): the model's points do not fit it")
