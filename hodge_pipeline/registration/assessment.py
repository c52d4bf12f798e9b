"""What a registration is worth: measured in the same way for every registrar, so that their edges can be mixed."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.types import Floats, Ints, Registration

MIN_POINTS = 11
"""small_gicp prints a warning for each cloud of ten or fewer."""
MIN_SIGMA_SHARE = 0.02
"""No sensor is better than 1/50 of the distance that it is matched within, 1 mm of 5 cm in a room: keeps noise-free
(modelled) pairs finite in any unit."""
SAME_FITNESS = 0.05
"""Difference of fitness below which two registrations of a pair fit its surfaces equally well."""
MOST_VIOLATION = 0.15
"""The share of the points in view that the other depth image may have seen through. Places that look alike differ in
what surrounds them. Of pairs that GICP registered, of red kitchen's every 20th to 40th frame and fr1/rpy's every third,
none of 975 within 12 cm of the truth has more, and 16 of 19 others have.
"""

FindNearest: TypeAlias = Callable[[Floats], tuple[Ints, Floats]]
"""Rows of the nearest target points, and squared distances in m², for query points (N, 3)."""


class Assessment(NamedTuple):
    """See `Registration` for the fields."""

    information: Floats
    fitness: float
    rmse_m: float
    correspondences: int


NOTHING = Assessment(np.zeros((6, 6)), 0.0, float("nan"), 0)


def assess(
    find_nearest: FindNearest,
    target_points: Floats,
    target_normals: Floats,
    source_points: Floats,
    source_normals: Floats,
    i_from_j: Floats,
    *,
    max_distance_m: float,
    points_per_sample: float,
) -> Assessment:
    """Fitness, RMSE and information of `i_from_j`, from the points of j with a point of i within the distance.

    The information is that of the point-to-plane error e = n·(p − q) under `i_from_j exp(ξ)`, ξ = (rotation,
    translation) in j's axes: Σ JᵀK / (s² c), J = (p_j × n, n) by the normals of i and K by those of j, with s the RMS
    of e over this pair (at least 1/50 of the distance). c = `points_per_sample` source points count as one independent
    measurement, since neighbours share their error. Directions that the surfaces do not fix, as within a plane, get
    none: the noise of a normal, which in JᵀJ would feign a constraint, is another one in K.
    """
    moved = se3.transform(i_from_j, source_points)
    if not np.isfinite(moved).all():
        return NOTHING
    rows, squared = find_nearest(moved)
    near = squared <= max_distance_m**2
    count = int(near.sum())
    if not count:
        return NOTHING
    normals = target_normals[rows[near]]
    plane_errors = np.einsum("ij,ij->i", normals, moved[near] - target_points[rows[near]])
    least = MIN_SIGMA_SHARE * max_distance_m
    variance = max(float(np.mean(plane_errors**2)), least**2)
    jacobian = plane_jacobian(normals @ i_from_j[:3, :3], source_points[near])
    again = plane_jacobian(source_normals[near], source_points[near])
    again *= np.sign(np.einsum("ni,ni->n", jacobian[:, 3:], again[:, 3:]))[:, None]  # estimated ones have any sign
    return Assessment(
        information=_semidefinite(jacobian.T @ again) / (variance * points_per_sample),
        fitness=count / len(source_points),
        rmse_m=float(np.sqrt(squared[near].mean())),
        correspondences=count,
    )


def plane_jacobian(normals_in_j: Floats, points_in_j: Floats) -> Floats:
    """Rows (p × n, n) (N, 6): the derivative of n·(i_from_j exp(ξ) p) by ξ = (rotation, translation) at 0."""
    return np.hstack([np.cross(points_in_j, normals_in_j), normals_in_j])


def _semidefinite(product: Floats) -> Floats:
    """The nearest symmetric positive semidefinite matrix, rotation and translation each in their own unit."""
    symmetric = (product + product.T) / 2
    parts = np.repeat([np.trace(symmetric[:3, :3]), np.trace(symmetric[3:, 3:])], 3)
    unit = np.sqrt(np.where(parts > 0, parts, 1.0))
    values, vectors = np.linalg.eigh(symmetric / np.outer(unit, unit))
    return np.asarray((vectors * np.maximum(values, 0.0)) @ vectors.T * np.outer(unit, unit))


def to_registration(assessment: Assessment, i_from_j: Floats, iterations: int, converged: bool) -> Registration:
    """The registrar's answer; with fewer than `MIN_POINTS` correspondences it has not converged, whatever the optimiser
    says.
    """
    return Registration(
        i_from_j=i_from_j,
        **assessment._asdict(),
        iterations=iterations,
        converged=converged and assessment.correspondences >= MIN_POINTS,
    )


def unregistered(i_from_j: Floats) -> Registration:
    """The answer where there is nothing to register: the guess, with no information and not converged."""
    return to_registration(NOTHING, i_from_j, iterations=0, converged=False)
