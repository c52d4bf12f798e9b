"""Motions of the plane are what `se3` says of all motions."""

import numpy as np
import pytest

from hodge_pipeline import se3
from hodge_pipeline.solvers.backbone import plane
from hodge_pipeline.solvers.weights import PLANAR_AXES

ANGLES = (0.0, 1e-12, 1e-8, 9e-5, 1.1e-4, 1e-2, 1.0, 3.0, np.pi - 1e-9)


@pytest.mark.parametrize("shape", [(), (0,), (3,), (2, 3)])
@pytest.mark.parametrize("angle", [*ANGLES, *(-angle for angle in ANGLES[1:])])
def test_the_plane_is_part_of_space(angle: float, shape: tuple[int, ...]) -> None:
    xi = np.concatenate([np.full((*shape, 1), angle), np.random.default_rng(0).normal(0, 50, (*shape, 2))], axis=-1)
    whole = np.zeros((*shape, 6))
    whole[..., PLANAR_AXES] = xi
    motions = plane.exp(xi)
    np.testing.assert_allclose(motions, se3.exp(whole), atol=1e-8)
    np.testing.assert_allclose(plane.log(motions), xi, atol=1e-8)


@pytest.mark.parametrize("shape", [(), (0,), (3,), (2, 3)])
def test_carried_covariances_are_those_of_space(shape: tuple[int, ...]) -> None:
    rng = np.random.default_rng(1)
    a = plane.exp(rng.normal(0, 3, (*shape, 3)))
    factor = rng.normal(size=(*shape, 3, 3))
    covariance = factor @ np.swapaxes(factor, -1, -2)
    adjoint = se3.adjoint(a)[..., PLANAR_AXES[:, None], PLANAR_AXES]
    np.testing.assert_array_equal(plane.adjoint(a), adjoint)
    expected = adjoint @ covariance @ np.swapaxes(adjoint, -1, -2)
    np.testing.assert_allclose(plane.carried(a, covariance), expected, atol=1e-10)


@pytest.mark.parametrize("shape", [(), (0,), (3,), (2, 3)])
def test_motions_between_poses_are_those_of_space(shape: tuple[int, ...]) -> None:
    a, b = plane.exp(np.random.default_rng(2).normal(0, 3, (2, *shape, 3)))
    np.testing.assert_allclose(plane.between(a, b), se3.inverse(a) @ b, atol=1e-12)
