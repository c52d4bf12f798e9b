"""Planar poses (x, y, θ) as motions in space: about z, in the plane z = 0."""

from __future__ import annotations

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.types import Floats

PLANAR_TWIST = np.array([3, 4, 2])
"""Where (x, y, θ) lie in (φ, ρ)."""


def lift_poses(poses: Floats) -> Floats:
    """Motions (N, 4, 4) about z of planar poses (N, 3) = (x, y, θ)."""
    rotation = np.broadcast_to(np.eye(3), (len(poses), 3, 3)).copy()
    cosine, sine = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    rotation[:, 0, 0] = rotation[:, 1, 1] = cosine
    rotation[:, 1, 0], rotation[:, 0, 1] = sine, -sine
    return se3.from_parts(rotation, np.pad(poses[:, :2], ((0, 0), (0, 1))))


def flatten_poses(motions: Floats) -> Floats:
    """Planar poses (N, 3) = (x, y, θ) of motions about z (N, 4, 4)."""
    angle = np.arctan2(motions[:, 1, 0], motions[:, 0, 0])
    return np.column_stack([motions[:, :2, 3], angle])


def lift_information(information: Floats) -> Floats:
    """6x6 matrices over (φ, ρ) of planar ones (E, 3, 3) over (x, y, θ), zero out of the plane."""
    out = np.zeros((len(information), 6, 6))
    out[:, PLANAR_TWIST[:, None], PLANAR_TWIST] = information
    return out


def flatten_information(information: Floats) -> Floats:
    """Planar matrices (E, 3, 3) over (x, y, θ) of 6x6 ones over (φ, ρ)."""
    return information[:, PLANAR_TWIST[:, None], PLANAR_TWIST]
