"""How far poses moved, and how well edges or tracks fix them: a change within its uncertainty is none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.complex.chi2 import MEDIAN_CHI2, chi2_by_information, tail_weight
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
TINY = float(np.finfo(float).tiny)


def mean_chi2(graph: ViewGraph, weights: Floats, world_from_cam: Floats) -> float:
    """The mean χ² of the edges at the poses (V, 4, 4), weighted by the solver's weights (E,); NaN where all are 0."""
    total = float(weights.sum())
    return float(weights @ chi2_by_information(graph, world_from_cam)) / total if total > 0 else float("nan")


def reduced_chi2(graph: ViewGraph, solution: Solution) -> float:
    """The weighted χ² of the edges used, by their degrees of freedom beyond those of the poses; NaN of a tree."""
    used = np.flatnonzero(solution.kept)
    freedom = 6 * (len(used) - graph.vertex_count + 1 + int(solution.component.max(initial=0)))
    if freedom <= 0:
        return float("nan")
    chi2 = chi2_by_information(graph.select(used), solution.world_from_cam)
    return float(solution.weights[used] @ chi2) / freedom


def pose_change(graph: ViewGraph, solution: Solution, before: Floats) -> PoseChange:
    """The change from the poses before (V, 4, 4) to the solution, with the uncertainty that the edges leave.

    The uncertainty is two standard deviations of a pose relative to the first of its component: marginals of the
    inverse normal matrix times the reduced χ², where that is above 1. NaN where the graph is a tree or singular.
    """
    used = np.flatnonzero(solution.kept)
    moved = se3.inverse(before) @ solution.world_from_cam
    translation_m = rms(np.linalg.norm(moved[:, :3, 3], axis=1))
    rotation_deg = float(np.rad2deg(rms(se3.rotation_angle(moved))))
    rows = evenly(graph.vertex_count, MOST_SAMPLED)
    rotation, translation = _sigmas(graph, solution, used, rows)
    return PoseChange(translation_m, rotation_deg, SIGMAS * translation, SIGMAS * float(np.rad2deg(rotation)))


def moves(before: Floats, after: Floats) -> Floats:
    """How far (B, 2) each body turned (radians) and moved from the poses before (B, 4, 4), see `_motions`."""
    return np.asarray(np.linalg.norm(_motions(before, after).reshape(-1, 2, 3), axis=2))


def _motions(before: Floats, after: Floats) -> Floats:
    """ξ (B, 6) of each body from the poses before (B, 4, 4), aligned by `se3.fit_poses`, to those after."""
    return se3.log(se3.inverse(se3.fit_poses(after, before) @ before) @ after)


def told_apart(start: TrackedModel, model: TrackedModel) -> bool:
    """Whether the model, of the start's size, is nearer to the truth than the start as far as its move tells.

    Where poses move by d, the start errs by τ² and tracks by v, the squared error falls by d² (τ² − v) / (τ² + v) in
    the mean: poses must gain more in directions that tracks fix than they lose in those left open, as in the bend of a
    long row. τ is half of the RMS move, of rotations and of positions: where all directions are alike, poses must move
    by two standard errors. So chosen, errors of 1508 simulated models fall to .47 of the start's in the geometric mean
    (.51 with twice this τ, .48 with half of it, 1.17 where every move is taken). What the model has more parallax than
    the start, in the median, does not count: of points at infinity an adjustment may make near ones, which seem to fix
    poses well. Bodies that tracks do not fix take no part.
    """
    told = model.information
    if not told.fixed.any():
        return False
    after = model.world_from_body[told.fixed]
    motions = _motions(start.world_from_body[told.fixed], after)
    usual = np.sqrt((motions.reshape(-1, 2, 3) ** 2).mean(axis=(0, 2))) / SIGMAS
    scale = np.tile(np.repeat(np.maximum(usual, np.finfo(float).eps), 3), len(after))
    moved = _without_gauge(motions.ravel() / scale, after, scale)
    before_deg, after_deg = (float(np.median(one.quality.parallaxes_deg)) for one in (start, model))
    nearer = max(1.0, after_deg / max(before_deg, TINY))
    gain, size = float(moved @ moved), told.groups.shape[-1]
    for group, own, part in zip(told.groups, moved.reshape(-1, size), scale.reshape(-1, size), strict=True):
        open_to_doubt = np.eye(size) + group * np.outer(part, part) / nearer**2
        gain -= 2.0 * float(own @ np.linalg.solve(open_to_doubt, own))
    return gain > 0


def likeliest(start: Floats, model: TrackedModel) -> Floats:
    """The most likely poses (B, 4, 4) by the model's tracks and by poses at the start (B, 4, 4), in its frame.

    The errors at the start follow Student's t, of sizes that the move tells. Those poses alone where bodies are so many
    that each one's information is given all others.
    """
    told = model.information
    if len(told.groups) != 1:
        return start
    poses = model.world_from_body.copy()
    moved = _motions(start[told.fixed], poses[told.fixed])
    squares = (moved.reshape(-1, 2, 3) ** 2).sum(axis=2)
    usual = np.maximum(np.median(squares, axis=0) / MEDIAN_CHI2[3], np.finfo(float).eps ** 2)
    scale = np.repeat(np.sqrt(usual / tail_weight(squares / usual, 3)), 3, axis=1).ravel()
    open_to_start = np.eye(len(scale)) + told.groups[0] * np.outer(scale, scale)
    back = scale * np.linalg.solve(open_to_start, moved.ravel() / scale)
    poses[told.fixed] = poses[told.fixed] @ se3.exp(-back.reshape(-1, 6))
    return poses


def _without_gauge(moved: Floats, world_from_body: Floats, scale: Floats) -> Floats:
    """Moves (6 B,), each divided by its `scale`, less what the whole turned, shifted and grew by."""
    turned = np.swapaxes(world_from_body[:, :3, :3], 1, 2)
    centres = world_from_body[:, :3, 3] - world_from_body[:, :3, 3].mean(axis=0)
    whole = np.zeros((len(turned), 6, 7))
    whole[:, :3, :3], whole[:, 3:, :3] = turned, -turned @ se3.hat(centres)
    whole[:, 3:, 3:6], whole[:, 3:, 6] = turned, np.einsum("bij,bj->bi", turned, centres)
    basis = np.linalg.qr(whole.reshape(-1, 7) / scale[:, None])[0]
    return np.asarray(moved - basis @ (basis.T @ moved))


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
    known = np.sqrt(3) * np.nan_to_num(model.information.standard_errors, nan=np.inf)
    return moves(start.world_from_body, model.world_from_body), np.maximum(known, TINY)


def _sigmas(graph: ViewGraph, solution: Solution, used: Ints, rows: Ints) -> tuple[float, float]:
    """RMS over the vertices `rows` of the standard deviations of rotation (radians) and translation (metres)."""
    reduced = reduced_chi2(graph, solution)
    if np.isnan(reduced):
        return float("nan"), float("nan")
    chosen, weights = graph.select(used), solution.weights[used]
    chosen = replace(chosen, information=chosen.information * weights[:, None, None])
    try:
        covariances = marginal_covariances(chosen, solution.world_from_cam, rows) * max(1.0, reduced)
    except (GraphError, np.linalg.LinAlgError, RuntimeError):  # a singular graph has no covariance
        return float("nan"), float("nan")
    spread = np.einsum("kii->ki", covariances)
    return rms(np.sqrt(spread[:, :3].sum(axis=1))), rms(np.sqrt(spread[:, 3:].sum(axis=1)))
