"""Group laws of se3 over every batch shape, and hand-derived answers."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from hodge_pipeline import se3
from hodge_pipeline.types import Trajectory
from readers_data import some_poses

SHAPES = st.sampled_from([(), (1,), (5,), (2, 3), (0,)])


@st.composite
def twists(draw: st.DrawFn, max_angle: float = 3.0) -> np.ndarray:
    """Twists of any batch shape with rotations below `max_angle`, tiny ones and zeros among them."""
    shape = draw(SHAPES)
    elements = st.one_of(st.just(0.0), st.floats(-1e-7, 1e-7), st.floats(-1, 1))
    xi = draw(hnp.arrays(float, (*shape, 6), elements=elements))
    xi[..., :3] *= max_angle / np.sqrt(3)
    xi[..., 3:] *= 10
    return xi


@settings(deadline=None)
@given(twists())
def test_log_inverts_exp(xi: np.ndarray) -> None:
    np.testing.assert_allclose(se3.log(se3.exp(xi)), xi, atol=1e-9)


@settings(deadline=None)
@given(twists())
def test_one_motion_is_that_of_a_batch(xi: np.ndarray) -> None:
    for one in xi.reshape(-1, 6):
        np.testing.assert_allclose(se3.exp(one), se3.exp(one[None])[0], atol=1e-12)


@settings(deadline=None)
@given(twists())
def test_pairing_log_inverts_pairing_exp(xi: np.ndarray) -> None:
    np.testing.assert_allclose(se3.pairing_log(se3.pairing_exp(xi)), xi, atol=1e-9)


@settings(deadline=None)
@given(twists())
def test_log_is_antisymmetric(xi: np.ndarray) -> None:
    motion = se3.exp(xi)
    np.testing.assert_allclose(se3.log(se3.inverse(motion)), -se3.log(motion), atol=1e-9)


@settings(deadline=None)
@given(twists())
def test_inverse(xi: np.ndarray) -> None:
    motion = se3.exp(xi)
    eye = np.broadcast_to(np.eye(4), motion.shape)
    np.testing.assert_allclose(se3.inverse(motion) @ motion, eye, atol=1e-12)


@settings(deadline=None)
@given(twists())
def test_adjoint_moves_a_twist_to_the_left(xi: np.ndarray) -> None:
    motion, small = se3.exp(xi), np.array([0.1, -0.2, 0.3, 0.4, 0.5, -0.6])
    left = se3.exp(np.einsum("...ij,j->...i", se3.adjoint(motion), small)) @ motion
    np.testing.assert_allclose(motion @ se3.exp(small), left, atol=1e-9)


@settings(deadline=None)
@given(twists())
def test_points_move_by_a_twist_as_its_derivative_says(xi: np.ndarray) -> None:
    points, small = np.array([[1.0, -2.0, 3.0], [0.0, 0.5, -4.0]]), 1e-6 * xi / np.abs(xi).max(initial=1.0)
    moved = se3.transform(se3.exp(small), points) - points
    np.testing.assert_allclose(moved, np.einsum("pij,...j->...pi", se3.by_twist(points), small), atol=1e-10)


@settings(deadline=None)
@given(twists())
def test_information_pulled_back_weighs_a_motion_as_on_the_other_side(xi: np.ndarray) -> None:
    motion, small = se3.exp(xi), np.array([0.1, -0.2, 0.3, 0.4, 0.5, -0.6]) / 10
    left = se3.log(motion @ se3.exp(small) @ se3.inverse(motion))
    factor = np.random.default_rng(0).normal(size=(6, 6))
    of_left = np.einsum("...i,ij,...j->...", left, factor @ factor.T, left)
    of_right = np.einsum("i,...ij,j->...", small, se3.pull_back(motion, factor @ factor.T), small)
    covariance = se3.carried(se3.inverse(motion), np.linalg.inv(factor @ factor.T))
    product = covariance @ se3.pull_back(motion, factor @ factor.T)
    np.testing.assert_allclose(product, np.broadcast_to(np.eye(6), product.shape), atol=1e-6)
    np.testing.assert_allclose(of_right, of_left, rtol=1e-6)


@settings(deadline=None)
@given(twists())
def test_quaternions_round_trip(xi: np.ndarray) -> None:
    motion = se3.exp(xi)
    quat = se3.to_quat_xyzw(motion)
    np.testing.assert_allclose(se3.from_quat_xyzw(motion[..., :3, 3], 7.0 * quat), motion, atol=1e-12)


@settings(deadline=None)
@given(twists(max_angle=1.0))
def test_left_jacobian_inverse(xi: np.ndarray) -> None:
    phi = xi[..., :3]
    product = se3.left_jacobian(phi) @ se3.left_jacobian_inverse(phi)
    np.testing.assert_allclose(product, np.broadcast_to(np.eye(3), product.shape), atol=1e-10)


def test_quarter_turn_about_z_by_hand() -> None:
    motion = se3.exp(np.array([0, 0, np.pi / 2, 1, 0, 0]))
    np.testing.assert_allclose(motion[:3, :3], [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-15)
    # V(φ) x for a quarter turn: the chord of the circle that is begun along x
    np.testing.assert_allclose(motion[:3, 3], [2 / np.pi, 2 / np.pi, 0], atol=1e-15)
    np.testing.assert_allclose(se3.transform(motion, np.array([[1.0, 0, 0]])), [[2 / np.pi, 1 + 2 / np.pi, 0]])


def test_pairing_log_is_not_antisymmetric() -> None:
    motion = se3.exp(np.array([0, 0, 1.0, 1, 0, 0]))
    assert np.abs(se3.pairing_log(se3.inverse(motion)) + se3.pairing_log(motion)).max() > 0.1


@pytest.mark.parametrize("angle", [1e-12, 1e-5, 9.9e-5, 1.01e-4, 1e-3])
def test_series_meets_closed_form(angle: float) -> None:
    phi = angle * np.array([0.6, 0.0, 0.8])
    step = 1e-3
    # V(φ) is the mean of exp(sφ) for s in [0, 1]
    shares = (np.arange(0, 1, step) + step / 2)[:, None]
    np.testing.assert_allclose(se3.left_jacobian(phi), se3.so3_exp(shares * phi).mean(axis=0), atol=1e-9)


def test_a_half_turn_has_a_logarithm() -> None:
    rotations = se3.so3_exp(np.array([[np.pi, 0, 0], [3.0, 0, 0], [0, 0, 0]]))
    np.testing.assert_allclose(np.abs(se3.log(se3.from_parts(rotations, np.zeros((3, 3))))[:, 0]), [np.pi, 3.0, 0.0])


@pytest.mark.parametrize("angle", [1e-100, 1e-12, 1e-4, 1.0, np.pi / 2, 2.1, np.pi - 1e-4, np.pi - 1e-9])
def test_rotation_logarithms_are_accurate_to_rounding_at_every_angle(angle: float) -> None:
    axes = np.random.default_rng(0).normal(size=(500, 3))
    phi = angle * np.concatenate([np.eye(3), -np.eye(3), axes / np.linalg.norm(axes, axis=1)[:, None]])
    np.testing.assert_allclose(se3.so3_log(se3.so3_exp(phi)), phi, rtol=0, atol=4e-15 * angle)


def test_projection_gives_the_nearest_rotation() -> None:
    rotation = se3.so3_exp(np.array([0.3, -0.2, 0.9]))
    np.testing.assert_allclose(se3.project_to_so3(0.9995 * rotation), rotation, atol=1e-12)
    mirrored = se3.project_to_so3(np.diag([1.0, 1.0, -1.0]))
    assert np.isclose(np.linalg.det(mirrored), 1.0)


def test_interpolation_ends_and_middle() -> None:
    a, b = se3.exp(np.array([0.1, 0, 0, 1, 2, 3.0])), se3.exp(np.array([0.5, 0.2, 0, 0, 2, 3.0]))
    ends = se3.interpolate(a, b, np.array([0.0, 1.0]))
    np.testing.assert_allclose(ends, [a, b], atol=1e-12)
    middle = se3.interpolate(a, b, np.array(0.5))
    np.testing.assert_allclose(se3.log(se3.inverse(a) @ middle), se3.log(se3.inverse(middle) @ b), atol=1e-12)


def test_is_motion_tells_bad_matrices() -> None:
    good = se3.exp(np.array([0.1, 0.2, 0.3, 4, 5, 6]))
    nan, singular, mirror, row = good.copy(), good.copy(), good.copy(), good.copy()
    nan[0, 3], singular[:3, 0], row[3, 0] = np.nan, 0, 1
    mirror[:3, :3] = np.diag([1.0, 1.0, -1.0])
    loose = good.copy()
    loose[:3, :3] *= 0.9998
    verdict = se3.is_motion(np.array([good, loose, nan, singular, mirror, row]))
    assert verdict.tolist() == [True, True, False, False, False, False]


def test_a_quaternion_has_no_negative_scalar_part() -> None:
    turns = np.radians(170) * np.concatenate([np.eye(3), -np.eye(3)])
    quats = se3.to_quat_xyzw(se3.exp(np.hstack([turns, np.zeros((6, 3))])))
    assert (quats[:, 3] >= 0).all()
    np.testing.assert_allclose(
        quats[:, :3], np.sin(np.radians(85)) * np.concatenate([np.eye(3), -np.eye(3)]), atol=1e-12
    )


def test_motions_between_poses_lead_from_one_to_the_other():
    sets = se3.exp(np.random.default_rng(0).normal(size=(2, 4, 6)))
    pairs = np.array([[0, 1], [3, 2]])
    found = se3.between(sets, pairs)
    np.testing.assert_allclose(sets[:, pairs[:, 0]] @ found, sets[:, pairs[:, 1]], atol=1e-12)
    np.testing.assert_array_equal(se3.between(sets[0], pairs), found[0])


def test_poses_on_a_line_fix_the_turn_about_it():
    poses = np.broadcast_to(np.eye(4), (3, 4, 4)).copy()
    poses[:, 0, 3] = [0.0, 1.0, 2.0]
    world_from_other = se3.exp(np.array([0.3, 0.0, 0.0, 1.0, 2.0, 3.0]))
    np.testing.assert_allclose(se3.fit_poses(world_from_other @ poses, poses), world_from_other, atol=1e-12)


def test_a_turn_counts_as_its_arc():
    motions = se3.exp(np.array([[0.0, 0.5, 0.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 3.0, 0.0, 4.0]]))
    np.testing.assert_allclose(se3.displacement_m(motions, 2.0), [1.0, 5.0])


def test_outside_the_trajectory_there_is_no_pose() -> None:
    trajectory = Trajectory(np.array([1.0, 2.0]), some_poses(2))
    poses = se3.poses_at(trajectory, np.array([0.99, 1.0, 1.5, 2.0, 2.01]), 1.0)
    assert np.isnan(poses[:, 0, 0]).tolist() == [True, False, False, False, True]
    np.testing.assert_allclose(poses[[1, 3]], trajectory.world_from_cam, atol=1e-12)


def test_a_pose_at_a_frames_own_stamp_is_its_truth_however_sparse_the_truth_is() -> None:
    trajectory = Trajectory(np.array([1.0, 2.0, 3.0]), some_poses(3))
    stamps_s = np.array([1.01, 1.5, 1.985, 3.01])
    poses = se3.poses_at(trajectory, stamps_s, 0.1, 0.02)
    assert np.isnan(poses[:, 0, 0]).tolist() == [False, True, False, True]
    dense = se3.poses_at(trajectory, stamps_s[[0, 2]], 1.0)
    np.testing.assert_array_equal(poses[[0, 2]], dense)
