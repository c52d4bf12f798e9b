"""`se3` for motions (..., 4, 4) in the plane z = 0 and twists (..., 3) = (φ, x, y), in a third of the time."""

from __future__ import annotations

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.types import Floats


def exp(xi: Floats) -> Floats:
    """Motions (..., 4, 4) of twists (..., 3)."""
    half = xi[..., 0] / 2
    sine, cosine = np.sin(half), np.cos(half)
    share = np.divide(sine, half, out=np.ones_like(half), where=half != 0)
    across, along = sine * share, cosine * share  # (1 − cos φ) / φ, sin φ / φ
    out = np.zeros((*half.shape, 4, 4))
    out[..., 0, 0] = out[..., 1, 1] = cosine**2 - sine**2
    out[..., 1, 0], out[..., 0, 1] = 2 * sine * cosine, -2 * sine * cosine
    out[..., 0, 3] = along * xi[..., 1] - across * xi[..., 2]
    out[..., 1, 3] = across * xi[..., 1] + along * xi[..., 2]
    out[..., 2, 2] = out[..., 3, 3] = 1.0
    return out


def log(motions: Floats) -> Floats:
    """Twists (..., 3) of motions (..., 4, 4)."""
    turn_y, turn_x = motions[..., 1, 0] - motions[..., 0, 1], motions[..., 0, 0] + motions[..., 1, 1]
    half = np.arctan2(turn_y, turn_x) / 2
    small = np.abs(half) < se3.SMALL_ANGLE
    along = np.where(small, 1 - half**2 / 3, half / np.tan(np.where(small, 1.0, half)))
    x, y = motions[..., 0, 3], motions[..., 1, 3]
    return np.stack([2 * half, along * x + half * y, along * y - half * x], axis=-1)


def between(a: Floats, b: Floats) -> Floats:
    """Motions `a⁻¹ b` (..., 4, 4)."""
    cosine, sine, ahead, aside = a[..., 0, 0], a[..., 1, 0], b[..., 0, 0], b[..., 1, 0]
    x, y = b[..., 0, 3] - a[..., 0, 3], b[..., 1, 3] - a[..., 1, 3]
    out = np.zeros(np.broadcast_shapes(a.shape, b.shape))
    out[..., 0, 0] = out[..., 1, 1] = cosine * ahead + sine * aside
    out[..., 1, 0] = cosine * aside - sine * ahead
    out[..., 0, 1] = -out[..., 1, 0]
    out[..., 0, 3], out[..., 1, 3] = cosine * x + sine * y, cosine * y - sine * x
    out[..., 2, 2] = out[..., 3, 3] = 1.0
    return out


def adjoint(motions: Floats) -> Floats:
    """Adjoint matrices (..., 3, 3)."""
    out = np.zeros((*motions.shape[:-2], 3, 3))
    out[..., 0, 0], out[..., 1, 0], out[..., 2, 0] = 1.0, motions[..., 1, 3], -motions[..., 0, 3]
    out[..., 1:, 1:] = motions[..., :2, :2]
    return out


def carried(motions: Floats, covariance: Floats) -> Floats:
    """Covariances `Ad Σ Adᵀ` (..., 3, 3)."""
    c, s, x, y = motions[..., 0, 0], motions[..., 1, 0], motions[..., 1, 3], -motions[..., 0, 3]
    turn, one, two = covariance[..., 0, 0], covariance[..., 1, 0], covariance[..., 2, 0]
    xx, xy, yy = covariance[..., 1, 1], covariance[..., 1, 2], covariance[..., 2, 2]
    one, two = c * one - s * two, s * one + c * two
    half, mixed = c * xx - s * xy, c * xy - s * yy
    xx, xy, yy = c * half - s * mixed, s * half + c * mixed, s * (s * xx + c * xy) + c * (s * xy + c * yy)
    first, second = one + x * turn, two + y * turn
    out = np.empty((*xx.shape, 3, 3))
    out[..., 0, 0], out[..., 1, 1], out[..., 2, 2] = turn, xx + x * (one + first), yy + y * (two + second)
    out[..., 0, 1] = out[..., 1, 0] = first
    out[..., 0, 2] = out[..., 2, 0] = second
    out[..., 1, 2] = out[..., 2, 1] = xy + y * one + x * second
    return out
