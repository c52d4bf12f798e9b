"""The point in a view's own axes at which errors of rotation and translation are least correlated: where it looks."""

from __future__ import annotations

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.types import Floats

ROUNDS = 20
FARTHEST = 2.0
"""Of the median translation: a point further off is a turning circle, not something that is seen."""
LEAST_GAIN = 0.3


def working_point(i_from_j: Floats, probability: Floats) -> tuple[Floats, float]:
    """The point (3,) that likely edges move least, `Z c ≈ c`, and how far they move it (median).

    Overlapping views look at the same things, so that their motion nearly fixes a point in front of them. The origin
    where no point is clearly better.
    """
    likely = probability >= np.quantile(probability, 0.5) if len(probability) else np.zeros(0, bool)
    rotation, shift = i_from_j[likely, :3, :3] - np.eye(3), i_from_j[likely, :3, 3]
    lengths = np.linalg.norm(shift, axis=1)
    usual = float(np.median(lengths)) if len(lengths) else 1.0
    if not len(lengths) or usual == 0:
        return np.zeros(3), usual or 1.0
    weight, point = np.ones(len(shift)), np.zeros(3)
    for _ in range(ROUNDS):
        normal = np.einsum("n,nij,nik->jk", weight, rotation, rotation) + 1e-3 * weight.sum() * np.eye(3)
        point = np.linalg.solve(normal, -np.einsum("n,nij,ni->j", weight, rotation, shift))
        displacement_m = np.linalg.norm(rotation @ point + shift, axis=1)
        weight = 1 / (1 + (displacement_m / max(float(np.median(displacement_m)), 1e-12)) ** 2)
    spread = float(np.median(np.linalg.norm(rotation @ point + shift, axis=1)))
    if np.linalg.norm(point) > FARTHEST * usual or spread > (1 - LEAST_GAIN) * usual:
        return np.zeros(3), usual
    return point, spread


def recentred(i_from_j: Floats, point: Floats) -> Floats:
    """The motions (E, 4, 4) between frames that are moved to the point: `S⁻¹ Z S`."""
    shift = se3.from_parts(np.eye(3), point)
    return np.asarray(se3.inverse(shift) @ i_from_j @ shift)
