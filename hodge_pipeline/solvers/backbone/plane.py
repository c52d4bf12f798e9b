"""Motions of the plane z = 0, as matrices (..., 4, 4), and their twists (..., 3) = (φ, x, y): as `se3` has it of all
motions, in a third of the time.
"""

from __future__ import annotations

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.types import Floats


def exp(xi: Floats) -> Floats:
    """Motions (..., 4, 4) of twists (..., 3)."""
    angle = xi[..., 0]
    half = angle / 2
    across = np.sin(half) * np.sinc(half / np.pi)  # (1 − cos φ) / φ
    along = np.sinc(angle / np.pi)  # sin φ / φ
    out = np.zeros((*xi.shape[:-1], 4, 4))
    out[..., 0, 0] = out[..., 1, 1] = np.cos(angle)
    out[..., 1, 0] = np.sin(angle)
    out[..., 0, 1] = -out[..., 1, 0]
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


def adjoint(motions: Floats) -> Floats:
    """Ad (..., 3, 3) of motions (..., 4, 4)."""
    out = np.zeros((*motions.shape[:-2], 3, 3))
    out[..., 0, 0] = 1.0
    out[..., 1, 0], out[..., 2, 0] = motions[..., 1, 3], -motions[..., 0, 3]
    out[..., 1:, 1:] = motions[..., :2, :2]
    return out
