"""How far poses moved, and how well edges or tracks fix them: a change within its uncertainty is none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.complex.chi2 import chi2_by_information
from hodge_pipeline.errors import GraphError
from hodge_pipeline.refine.guard import PoseChange
from hodge_pipeline.solvers.covariance import marginal_covariances
from hodge_pipeline.types import Bools, Floats, Ints, Solution, ViewGraph
from hodge_pipeline.types.arrays import evenly, rms
from hodge_pipeline.types.tracked_model import TrackedModel

MOST_SAMPLED = 60
"""Poses whose covariance is computed: enough for a root mean square."""
SIGMAS = 2.0
"""Standard deviations in a stated uncertainty: 95 % of a Gaussian."""
LEAST_WEIGHT = 1e-3
"""Weight below which a robust solver counts as having left an edge out: some keep a small rest."""


def mean_chi2(graph: ViewGraph, weights: Floats, world_from_cam: Floats) -> float:
    """The mean χ² of the edges at the poses (V, 4, 4), weighted by the solver's weights (E,); NaN where all are 0."""
    total = float(weights.sum())
    return float(weights @ chi2_by_information(graph, world_from_cam)) / total if total > 0 else float("nan")


def pose_change(graph: ViewGraph, solution: Solution, before: Floats) -> PoseChange:
    """The change from the poses before (V, 4, 4) to the solution, with the uncertainty that the edges leave.

    The uncertainty is two standard deviations of a pose relative to the first of its component: marginals of the
    inverse normal matrix times the reduced χ², where that is above 1. NaN where the graph is a tree or singular.
    """
    used = np.flatnonzero(solution.weights > LEAST_WEIGHT)
    moved = se3.inverse(before) @ solution.world_from_cam
    translation_m = rms(np.linalg.norm(moved[:, :3, 3], axis=1))
    rotation_deg = float(np.rad2deg(rms(se3.rotation_angle(moved))))
    rows = evenly(graph.vertex_count, MOST_SAMPLED)
    rotation, translation = _sigmas(graph, solution, used, rows)
    return PoseChange(translation_m, rotation_deg, SIGMAS * translation, SIGMAS * float(np.rad2deg(rotation)))


def moves(before: Floats, after: Floats) -> Floats:
    """How far (B, 2) each body turned (radians) and moved, the poses before (B, 4, 4) rigidly aligned to those after.

    The rotation is aligned by orientations, since a few positions may leave it open.
    """
    turn = se3.project_to_so3((after[:, :3, :3] @ np.swapaxes(before[:, :3, :3], 1, 2)).sum(axis=0))
    shift = (after[:, :3, 3] - before[:, :3, 3] @ turn.T).mean(axis=0)
    moved = se3.log(se3.inverse(se3.from_parts(turn, shift) @ before) @ after)
    return np.asarray(np.linalg.norm(moved.reshape(-1, 2, 3), axis=2))


def told_apart(start: TrackedModel, model: TrackedModel) -> bool:
    """Whether the model, of the start's size, moved by more than its uncertainty, in the mean or the median.

    A model that moved by less may be farther from the truth than the start: both errors add up to the move. What the
    model has more parallax than the start, in the median, does not count: of points at infinity an adjustment may make
    near ones, which seem to fix poses well. Bodies that tracks do not fix take no part.
    """
    moved, known = _moved_and_known(start, model)
    before, after = (float(np.median(one.quality.parallaxes_deg)) for one in (start, model))
    known = known * max(1.0, after / max(before, np.finfo(float).tiny))
    fixed = np.isfinite(known).all(axis=1)
    moved, known = moved[fixed], known[fixed]
    total = (moved**2).sum(axis=0) > SIGMAS**2 * (known**2).sum(axis=0)
    return bool(fixed.any()) and bool((total | (np.median(moved / known, axis=0) > SIGMAS)).any())


def loose(start: TrackedModel, model: TrackedModel) -> Bools:
    """Bodies (B,) that moved by more than the median standard error, their own exceeding the RMS move and twice the
    median one: they may be worse now.
    """
    moved, known = _moved_and_known(start, model)
    usual = np.median(known, axis=0)
    least = np.maximum(np.sqrt((moved**2).mean(axis=0)), SIGMAS * usual)
    return np.asarray(((known > least) & (moved > usual)).any(axis=1))


def _moved_and_known(start: TrackedModel, model: TrackedModel) -> tuple[Floats, Floats]:
    """Moves and standard errors (B, 2) of rotation and position, over three axes; infinite where tracks tell none."""
    known = np.sqrt(3) * np.nan_to_num(model.standard_errors(), nan=np.inf)
    return moves(start.world_from_body, model.world_from_body), np.maximum(known, np.finfo(float).tiny)


def _sigmas(graph: ViewGraph, solution: Solution, used: Ints, rows: Ints) -> tuple[float, float]:
    """RMS over the vertices `rows` of the standard deviations of rotation (radians) and translation (metres)."""
    chosen = graph.select(used)
    weights = solution.weights[used]
    chosen = replace(chosen, information=chosen.information * weights[:, None, None])
    freedom = 6 * (len(used) - graph.vertex_count + 1 + int(solution.component.max(initial=0)))
    if freedom <= 0:
        return float("nan"), float("nan")
    inflation = max(1.0, float(chi2_by_information(chosen, solution.world_from_cam).sum()) / freedom)
    try:
        covariances = marginal_covariances(chosen, solution.world_from_cam, rows) * inflation
    except (GraphError, np.linalg.LinAlgError, RuntimeError):  # a singular graph has no covariance
        return float("nan"), float("nan")
    spread = np.einsum("kii->ki", covariances)
    return rms(np.sqrt(spread[:, :3].sum(axis=1))), rms(np.sqrt(spread[:, 3:].sum(axis=1)))
