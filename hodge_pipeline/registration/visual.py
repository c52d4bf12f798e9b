"""The motion between two frames from their landmarks: matches, a consensus of triples, then least squares.

A landmark's error is that of its pixel, sideways, and that of the depth camera, along the ray: a match counts by the
sum of both covariances, so that far landmarks weigh little and none weighs along its ray as much as across.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.types import Floats

TRIPLES = 300
FEWEST_MATCHES = 8
PIXEL_SIGMA = 0.75
"""Pixels: a feature's own error, once the shutter's is taken out, on TUM fr1."""
DEPTH_SIGMAS = 2.0
"""What `depth_sigma`, the noise of one pixel on a plane, is taken times: features lie where depth is worst."""
GATE = 3.0
"""Standard deviations, in each of three axes, at which a match stops to count."""
GATE_PIXEL_SIGMA = 1.5
"""Pixels: what a match may err by and still be right, blur and a camera that turns fast included."""
STEPS = 8


@dataclass(frozen=True)
class VisualMotion:
    """`i_from_j (4, 4)`, its information (6, 6) over `i_from_j exp(ξ)`, and how many matches agree with it."""

    i_from_j: Floats
    information: Floats
    inliers: int
    matches: int


def depth_sigma(z_m: Floats) -> Floats:
    """Standard deviation in metres of a structured-light depth (Nguyen, Izadi and Lovell 2012, axial noise)."""
    return np.asarray(0.0012 + 0.0019 * (z_m - 0.4) ** 2)


def covariances(points: Floats, pixel_sigma_rad: Floats, depth_sigmas: float) -> Floats:
    """Covariances (n, 3, 3) of landmarks (n, 3) in their camera's axes: depth along the ray, the pixel (n,) across."""
    z = points[:, 2]
    ray = points / z[:, None]
    across, along = (pixel_sigma_rad * z) ** 2, (depth_sigmas * depth_sigma(z)) ** 2
    return np.asarray(
        across[:, None, None] * np.diag([1.0, 1.0, 0.0]) + along[:, None, None] * ray[:, :, None] * ray[:, None, :]
    )


def visual_motion(
    points_i: Floats, points_j: Floats, pixels_rad: tuple[Floats, Floats], seed: int
) -> VisualMotion | None:
    """The motion that most matched landmarks (M, 3) agree on, None where too few do; `pixels_rad` (M,) each are the
    angles that a pixel covers there.
    """
    count = len(points_i)
    if count < FEWEST_MATCHES:
        return None
    both = tuple(zip((points_i, points_j), pixels_rad, strict=True))
    errors_i, errors_j = (covariances(points, PIXEL_SIGMA * pixel, DEPTH_SIGMAS) for points, pixel in both)
    gate_i, gate_j = (covariances(points, GATE_PIXEL_SIGMA * pixel, 1.0) for points, pixel in both)
    rows = np.random.default_rng(seed).integers(0, count, (TRIPLES, 3))
    guesses = se3.fit_rigid(points_i[rows], points_j[rows])
    spread = (np.trace(gate_i, axis1=1, axis2=2) + np.trace(gate_j, axis1=1, axis2=2)) / 3
    apart = _squares_apart(points_i, points_j, guesses) / ((2 * GATE) ** 2 * spread)
    best = int(np.argmax(np.maximum(1 - apart, 0).sum(axis=1)))
    motion, inlier = guesses[best], apart[best] < 1
    turn = motion[:3, :3]  # the steps add a degree at most, which changes these errors by nothing
    weight, gate = (
        np.linalg.inv(of_i + turn @ of_j @ turn.T) for of_i, of_j in ((errors_i, errors_j), (gate_i, gate_j))
    )
    for _ in range(STEPS):
        if inlier.sum() < FEWEST_MATCHES:
            return None
        step, information = _step(points_i[inlier], points_j[inlier], weight[inlier], motion)
        motion = motion @ se3.exp(step)
        before, inlier = inlier, _squares(gate, points_i - se3.transform(motion, points_j)) < 3 * GATE**2
        if np.linalg.norm(step) < 1e-5 and (before == inlier).all():
            break
    if inlier.sum() < FEWEST_MATCHES:
        return None
    return VisualMotion(motion, information, int(inlier.sum()), count)


def _squares_apart(points_i: Floats, points_j: Floats, guesses: Floats) -> Floats:
    """Squared distances (G, M) of matched points under each motion (G, 4, 4), |p − R q − t|² multiplied out: one
    product of matrices for all.
    """
    turns, shifts = guesses[:, :3, :3], guesses[:, :3, 3]
    turned_back = (shifts[:, None] @ turns)[:, 0]
    ones = np.ones((len(guesses), 1))
    squared = (shifts**2).sum(axis=1, keepdims=True)
    of_guess = np.hstack([-2 * turns.reshape(-1, 9), -2 * shifts, 2 * turned_back, squared, ones])
    products = (points_i[:, :, None] * points_j[:, None]).reshape(-1, 9)
    lengths = (points_i**2 + points_j**2).sum(axis=1, keepdims=True)
    return np.asarray(of_guess @ np.hstack([products, points_i, points_j, np.ones_like(lengths), lengths]).T)


def _squares(weight: Floats, residual: Floats) -> Floats:
    return np.asarray(((weight @ residual[:, :, None])[:, :, 0] * residual).sum(axis=1))


def _step(points_i: Floats, points_j: Floats, weight: Floats, i_from_j: Floats) -> tuple[Floats, Floats]:
    """The Gauss-Newton step ξ (6,) and the information (6, 6), Cauchy weights within the consensus; `weight (m, 3, 3)`
    are the inverse covariances of the residuals, in i's axes.
    """
    residual = points_i - se3.transform(i_from_j, points_j)
    weight = weight / (1 + _squares(weight, residual) / 3)[:, None, None]
    turn = i_from_j[:3, :3]
    jacobian = np.concatenate([-turn @ se3.hat(points_j), np.broadcast_to(turn, (len(points_j), 3, 3))], axis=2)
    weighted = (weight @ jacobian).reshape(-1, 6)
    information, gradient = jacobian.reshape(-1, 6).T @ weighted, weighted.T @ residual.ravel()
    return np.linalg.solve(information + 1e-9 * np.trace(information) * np.eye(6), gradient), information
