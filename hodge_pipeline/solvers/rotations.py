"""Batches of d x d rotations, d = 2 or 3, and their tangent vectors with p = 1 or 3 components."""

from __future__ import annotations

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.types import Floats

NEARLY_ROTATIONS = 1e-8
"""Off orthonormal: one step without an inverse mends it to rounding."""


def exponential(omega: Floats) -> Floats:
    """Rotations (N, d, d) of tangent vectors (N, p)."""
    if omega.shape[1] == 1:
        cosine, sine = np.cos(omega[:, 0]), np.sin(omega[:, 0])
        return np.stack([cosine, -sine, sine, cosine], axis=1).reshape(-1, 2, 2)
    return se3.so3_exp(omega)


def axial(matrices: Floats) -> Floats:
    """Vectors b (N, p) of matrices B (N, d, d) with d tr(exp(ω^) B) = −ω · b: twice the axis of the skew part."""
    b = matrices
    if b.shape[-1] == 2:
        return np.asarray(b[:, 1:, 0] - b[:, :1, 1])
    return np.stack([b[:, 2, 1] - b[:, 1, 2], b[:, 0, 2] - b[:, 2, 0], b[:, 1, 0] - b[:, 0, 1]], axis=1)


def cross(a: Floats, b: Floats) -> Floats:
    """The cross products a x b (N, p) of vectors (N, d)."""
    if a.shape[1] == 2:
        return np.asarray(a[:, :1] * b[:, 1:] - a[:, 1:] * b[:, :1])
    return np.stack(
        [
            a[:, 1] * b[:, 2] - a[:, 2] * b[:, 1],
            a[:, 2] * b[:, 0] - a[:, 0] * b[:, 2],
            a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0],
        ],
        axis=1,
    )


def lever(vectors: Floats) -> Floats:
    """Matrices (N, d, p) with `lever(u) @ ω = u x ω`, the negative of how u moves when it is turned by ω."""
    if vectors.shape[1] == 2:
        return np.stack([vectors[:, 1], -vectors[:, 0]], axis=1)[:, :, None]
    return se3.hat(vectors)


def project(matrices: Floats) -> Floats:
    """The nearest rotations (N, d, d) in the Frobenius norm."""
    if matrices.shape[-1] == 2:
        cosine = matrices[:, 0, 0] + matrices[:, 1, 1]
        sine = matrices[:, 1, 0] - matrices[:, 0, 1]
        return exponential(np.arctan2(sine, cosine)[:, None])
    gram = matrices @ np.swapaxes(matrices, 1, 2)
    if np.abs(gram - np.eye(3)).max(initial=0.0) < NEARLY_ROTATIONS and (np.linalg.det(matrices) > 0).all():
        return np.asarray(1.5 * matrices - 0.5 * (gram @ matrices))
    return se3.project_to_so3(matrices)
