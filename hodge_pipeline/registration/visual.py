"""The motion between two frames from their landmarks: matches, a consensus of triples, then least squares.

A landmark's error is that of its pixel, sideways, and that of the depth camera, along the ray: a match counts by the
sum of both covariances, so that far landmarks weigh little and none weighs along its ray as much as across.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.registration.pixels import DEPTH_SIGMAS, depth_sigma
from hodge_pipeline.types import Bools, Floats

TRIPLES = 300
"""Of matches, drawn at random: where 30 % are right, no triple is in 0.03 % of pairs."""
FEWEST_MATCHES = 8
"""As many agree by chance in unrelated frames: see `Rgbd.min_inliers`."""
GATE = 3.0
"""Standard deviations of an inlier, at most, in each of three axes."""
LANDMARK_PIXEL_SIGMA = 0.5
"""Pixels: sigma of a landmark's own error. At true motions, the shutter's share taken out, matches have 0.15 and 0.3 on
two rendered videos, 0.45 on TUM fr1/xyz, 0.65 on the blurred fr1/rpy. With 0.75 depth, whose errors neighbours share,
bends motions more; with 0.35 fr1/rpy's every second frame, whose velocities are rough, has twice its error.
"""
GATE_PIXEL_SIGMA = 1.5
"""Pixels: sigma of an inlier's error for the gate, blur and a camera that turns fast included."""
STEPS = 8
"""Of least squares on the inliers, at most: a limit on cost."""
ON_A_LINE = 1e-6
"""Area of a triangle, over the square of its size, below which rounding decides on its plane."""


@dataclass(frozen=True)
class VisualMotion:
    """`i_from_j (4, 4)`, its information (6, 6) over `i_from_j exp(ξ)`, and how many matches agree with it."""

    i_from_j: Floats
    information: Floats
    inliers: int


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
    errors_i, errors_j = (covariances(points, LANDMARK_PIXEL_SIGMA * pixel, DEPTH_SIGMAS) for points, pixel in both)
    gate_i, gate_j = (covariances(points, GATE_PIXEL_SIGMA * pixel, 1.0) for points, pixel in both)
    rows = np.random.default_rng(seed).integers(0, count, (TRIPLES, 3))
    guesses = fit_triples(points_i[rows], points_j[rows])
    spread = (np.trace(gate_i, axis1=1, axis2=2) + np.trace(gate_j, axis1=1, axis2=2)) / 3
    apart = _squares_apart(points_i, points_j, guesses) / ((2 * GATE) ** 2 * spread)
    best = int(np.argmax(np.fmax(1 - apart, 0).sum(axis=1)))  # nothing for the NaN of points on a line
    motion, inlier = guesses[best], apart[best] < 1
    turn = motion[:3, :3]  # the steps add a degree at most, which changes these errors by nothing
    weight, gate = (
        np.linalg.inv(turn.T @ of_i @ turn + of_j) for of_i, of_j in ((errors_i, errors_j), (gate_i, gate_j))
    )
    step_to = _steps(points_j, weight)
    residual = _residual(points_i, points_j, motion)
    for _ in range(STEPS):
        if inlier.sum() < FEWEST_MATCHES:
            return None
        step, information = step_to(residual, inlier)
        motion = motion @ se3.exp(step)
        residual = _residual(points_i, points_j, motion)
        before, inlier = inlier, _squares(gate, residual) < 3 * GATE**2
        if np.linalg.norm(step) < 1e-5 and (before == inlier).all():
            break
    if inlier.sum() < FEWEST_MATCHES:
        return None
    return VisualMotion(motion, information, int(inlier.sum()))


def fit_triples(points_b: Floats, points_a: Floats) -> Floats:
    """The motions `b_from_a (T, 4, 4)` of least squares between three points each (T, 3, 3), those of `se3.fit_rigid`
    in a fifth of its time; NaN where the points of one lie on a line.

    About their mean three points lie in a plane: the planes are laid on each other, and what is left is one angle.
    """
    centres, planes = [], []
    for points in (points_b, points_a):
        by_axis = np.ascontiguousarray(points.T)  # axis, point, triple
        centres.append(by_axis.mean(axis=1))
        planes.append(_in_plane(by_axis - centres[-1][:, None]))
    (x_b, y_b, normal_b, u_b, v_b), (x_a, y_a, normal_a, u_a, v_a) = planes
    cosine, sine = (u_b * u_a + v_b * v_a).sum(axis=0), (v_b * u_a - u_b * v_a).sum(axis=0)
    length = np.hypot(cosine, sine)
    cosine, sine = cosine / length, sine / length
    turned_x, turned_y = x_b * cosine + y_b * sine, y_b * cosine - x_b * sine
    rotation = turned_x[:, None] * x_a + turned_y[:, None] * y_a + normal_b[:, None] * normal_a
    shift = centres[0] - (rotation * centres[1]).sum(axis=1)
    return se3.from_parts(rotation.transpose(2, 0, 1), shift.T)


def _in_plane(points: Floats) -> tuple[Floats, ...]:
    """Axes x, y and normal (3, T) of the plane of three points about their mean (3 axes, 3 points, T), and where along
    x and y (3, T) each point lies.
    """
    long, other, normal = points[:, 0], points[:, 1], _cross(points[:, 0], points[:, 1])
    lengths = np.sqrt([(long**2).sum(axis=0), (other**2).sum(axis=0), (normal**2).sum(axis=0)])
    on_a_line = ~(lengths[2] > ON_A_LINE * (lengths[0] + lengths[1]) ** 2)
    x, normal = long / np.where(on_a_line, np.nan, lengths[0]), normal / np.where(on_a_line, np.nan, lengths[2])
    y = _cross(normal, x)
    return x, y, normal, (x[:, None] * points).sum(axis=0), (y[:, None] * points).sum(axis=0)


def _cross(a: Floats, b: Floats) -> Floats:
    """Cross products (3, T): np.cross takes four times as long."""
    return np.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


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
    return np.asarray(np.einsum("ni,nij,nj->n", residual, weight, residual))


def _residual(points_i: Floats, points_j: Floats, i_from_j: Floats) -> Floats:
    """How far (n, 3) the points of i lie from those of j, in j's axes."""
    return np.asarray((points_i - i_from_j[:3, 3]) @ i_from_j[:3, :3] - points_j)


def _steps(points_j: Floats, weight: Floats) -> Callable[[Floats, Bools], tuple[Floats, Floats]]:
    """From residuals (n, 3) and those that count (n,) to the Gauss-Newton step ξ (6,) and the information (6, 6), with
    Cauchy weights; `weight (n, 3, 3)` are the inverse covariances of the residuals, in j's axes.
    """
    jacobian = se3.by_twist(points_j)
    weighted = weight @ jacobian
    each = (np.swapaxes(jacobian, 1, 2) @ weighted).reshape(-1, 36)
    flat = weighted.reshape(-1, 6)

    def step(residual: Floats, inlier: Bools) -> tuple[Floats, Floats]:
        share = inlier / (1 + _squares(weight, residual) / 3)
        information = (share @ each).reshape(6, 6)
        gradient = (share[:, None] * residual).ravel() @ flat
        return np.linalg.solve(information + 1e-9 * np.trace(information) * np.eye(6), gradient), information

    return step
