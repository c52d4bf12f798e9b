"""How well the edges fix the poses, and how far the poses moved: the two that a change is judged by."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.complex.chi2 import chi2_by_information
from hodge_pipeline.errors import GraphError
from hodge_pipeline.refine.guard import Change
from hodge_pipeline.solvers.covariance import marginal_covariances
from hodge_pipeline.stages import TrackedModel
from hodge_pipeline.types import Bools, Floats, Ints, Solution, ViewGraph
from hodge_pipeline.types.arrays import evenly

MOST_SAMPLED = 60
"""Poses at which the covariance is taken: enough for a root mean square."""
SIGMAS = 2.0
LEAST_WEIGHT = 1e-3


def mean_chi2(graph: ViewGraph, weights: Floats, world_from_cam: Floats) -> float:
    """The mean χ² of the edges, each by the weight (E,) that the solver gave it; NaN where none has any."""
    total = float(weights.sum())
    return float(weights @ chi2_by_information(graph, world_from_cam)) / total if total > 0 else float("nan")


def change(graph: ViewGraph, solution: Solution, before: Floats) -> Change:
    """The change from the poses before (V, 4, 4) to the solution, with the uncertainty that the edges leave.

    The uncertainty is two standard deviations of a pose against the first of its component, from the inverse of the
    normal equations, scaled by what the residuals say of the edges' own information. NaN where it cannot be had.
    """
    used = np.flatnonzero(solution.weights > LEAST_WEIGHT)
    moved = se3.inverse(before) @ solution.world_from_cam
    translation_m = _rms(np.linalg.norm(moved[:, :3, 3], axis=1))
    rotation_deg = float(np.rad2deg(_rms(se3.rotation_angle(moved))))
    rows = evenly(graph.vertex_count, MOST_SAMPLED)
    rotation, translation = _sigmas(graph, solution, used, rows)
    return Change(translation_m, rotation_deg, SIGMAS * translation, SIGMAS * float(np.rad2deg(rotation)))


def moves(before: Floats, after: Floats) -> Floats:
    """How far (B, 2) rotations (rad) and positions moved, the poses before laid rigidly onto those after.

    By their orientations, which small sets of positions lack.
    """
    turn = se3.project_to_so3((after[:, :3, :3] @ np.swapaxes(before[:, :3, :3], 1, 2)).sum(axis=0))
    shift = (after[:, :3, 3] - before[:, :3, 3] @ turn.T).mean(axis=0)
    moved = se3.log(se3.inverse(se3.from_parts(turn, shift) @ before) @ after)
    return np.asarray(np.linalg.norm(moved.reshape(-1, 2, 3), axis=2))


def told_apart(start: TrackedModel, model: TrackedModel) -> bool:
    """Whether the model, of the size of the start, moved by more than tracks leave open, in the mean or the median.

    What moved by less may well be farther from the truth than the start: the errors of both add up to the move.
    """
    moved, known = _moved_and_known(start, model)
    total = (moved**2).sum(axis=0) > SIGMAS**2 * (known**2).sum(axis=0)
    return bool((total | (np.median(moved / known, axis=0) > SIGMAS)).any())


def loose(start: TrackedModel, model: TrackedModel) -> Bools:
    """Which bodies (B,) moved though tracks fix them far less well than the others, and than the poses moved: they may
    be worse now.
    """
    moved, known = _moved_and_known(start, model)
    usual = np.median(known, axis=0)
    least = np.maximum(np.sqrt((moved**2).mean(axis=0)), SIGMAS * usual)
    return np.asarray(((known > least) & (moved > usual)).any(axis=1))


def _moved_and_known(start: TrackedModel, model: TrackedModel) -> tuple[Floats, Floats]:
    """Moves and standard errors (B, 2), of three axes together; infinite where the tracks tell none."""
    known = np.sqrt(3) * np.nan_to_num(model.standard_errors(), nan=np.inf)
    return moves(start.world_from_body, model.world_from_body), np.maximum(known, np.finfo(float).tiny)


def _sigmas(graph: ViewGraph, solution: Solution, used: Ints, rows: Ints) -> tuple[float, float]:
    """Root mean squares over the rows of the standard deviations of rotation (radians) and translation (metres)."""
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
    return _rms(np.sqrt(spread[:, :3].sum(axis=1))), _rms(np.sqrt(spread[:, 3:].sum(axis=1)))


def _rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(values**2))) if len(values) else float("nan")
