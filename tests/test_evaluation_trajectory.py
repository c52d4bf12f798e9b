"""Trajectory errors against evo, by hand, and where they are not defined."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hodge_pipeline import se3
from hodge_pipeline.errors import GraphError
from hodge_pipeline.evaluation.trajectory import absolute_error, align, associate, relative_error
from hodge_pipeline.types import Floats

EVO = "trajectories/evo"


def read_tum(path: Path) -> tuple[Floats, Floats]:
    table = np.loadtxt(path)
    return table[:, 0], se3.from_quat_xyzw(table[:, 1:4], table[:, 4:])


def read_kitti(path: Path) -> Floats:
    rows = np.loadtxt(path).reshape(-1, 3, 4)
    return se3.from_parts(rows[:, :, :3], rows[:, :, 3])


def tum_pair(folder: Path, estimate: str, reference: str) -> tuple[Floats, Floats]:
    stamps, poses = read_tum(folder / estimate)
    true_stamps, truth = read_tum(folder / reference)
    rows, true_rows = associate(stamps, true_stamps)
    return poses[rows], truth[true_rows]


def random_poses(count: int, seed: int = 0) -> Floats:
    return se3.exp(np.random.default_rng(seed).normal(size=(count, 6)))


@pytest.mark.parametrize(
    ("estimate", "reference", "with_scale", "rmse_m"),
    [
        ("freiburg1_xyz-rgbdslam.txt", "freiburg1_xyz-groundtruth.txt", False, 0.01347),
        ("fr2_desk_ORB.txt", "fr2_desk_groundtruth.txt", False, 0.00812),
        ("fr2_desk_ORB_kf_mono.txt", "fr2_desk_groundtruth.txt", True, 0.00773),
    ],
)
def test_published_errors_of_tum(
    data_dir: Path, estimate: str, reference: str, with_scale: bool, rmse_m: float
) -> None:
    error = absolute_error(*tum_pair(data_dir / EVO, estimate, reference), with_scale=with_scale)
    assert error.rmse_m == pytest.approx(rmse_m, abs=5e-6)
    assert error.left_out == 0


@pytest.mark.parametrize(("estimate", "rmse_m"), [("KITTI_00_ORB.txt", 1.303), ("KITTI_00_SPTAM.txt", 3.738)])
def test_published_errors_of_kitti(data_dir: Path, estimate: str, rmse_m: float) -> None:
    poses, truth = (read_kitti(data_dir / EVO / name) for name in (estimate, "KITTI_00_gt.txt"))
    assert absolute_error(poses, truth).rmse_m == pytest.approx(rmse_m, abs=5e-4)


@pytest.mark.parametrize("delta_frames", [1, 10])
def test_relative_error_equals_evo(data_dir: Path, delta_frames: int) -> None:
    metrics = pytest.importorskip("evo.core.metrics")
    trajectory = pytest.importorskip("evo.core.trajectory")
    estimate, reference = tum_pair(data_dir / EVO, "freiburg1_xyz-rgbdslam.txt", "freiburg1_xyz-groundtruth.txt")
    ours = relative_error(estimate, reference, delta_frames)
    pair = tuple(trajectory.PosePath3D(poses_se3=list(poses)) for poses in (reference, estimate))
    for relation, rmse in (
        (metrics.PoseRelation.translation_part, ours.translation_rmse_m),
        (metrics.PoseRelation.rotation_angle_deg, ours.rotation_rmse_deg),
    ):
        theirs = metrics.RPE(relation, delta_frames, metrics.Unit.frames, all_pairs=True)
        theirs.process_data(pair)
        assert rmse == pytest.approx(theirs.get_statistic(metrics.StatisticsType.rmse), rel=1e-6)


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 1000), scale=st.floats(0.1, 10))
def test_alignment_undoes_any_similarity(seed: int, scale: float) -> None:
    reference, move = random_poses(8, seed), random_poses(1, seed + 1)[0]
    estimate = reference.copy()
    estimate[:, :3, 3] *= scale
    found = align(move @ estimate, reference, with_scale=True)
    assert found.scale == pytest.approx(1 / scale)
    assert not found.degenerate
    np.testing.assert_allclose(found.apply(move @ estimate), reference, atol=1e-9)


def test_statistics_by_hand() -> None:
    reference = np.tile(np.eye(4), (4, 1, 1))
    reference[:, :3, 3] = [[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]]
    estimate = reference.copy()
    estimate[:2, 2, 3], estimate[2:, 2, 3] = 0.1, -0.1  # two up, two down: no rigid motion helps
    error = absolute_error(estimate, reference)
    assert (error.rmse_m, error.median_m, error.max_m) == pytest.approx((0.1,) * 3)
    np.testing.assert_allclose(error.per_frame_m, 0.1)


@pytest.mark.parametrize("count", [1, 2, 5])
def test_positions_on_a_line_are_aligned_by_the_orientations(count: int) -> None:
    reference = np.tile(np.eye(4), (count, 1, 1))
    reference[:, 0, 3] = np.arange(count)
    found = align(random_poses(1)[0] @ reference, reference)
    assert found.degenerate
    np.testing.assert_allclose(found.apply(random_poses(1)[0] @ reference), reference, atol=1e-9)


def test_positions_decide_before_orientations_on_a_line() -> None:
    reference = np.tile(np.eye(4), (5, 1, 1))
    reference[:, 0, 3] = np.arange(5)
    turned = reference @ se3.exp(np.array([0.3, 0.2, 0.1, 0.0, 0.0, 0.0]))
    assert absolute_error(turned, reference).rmse_m < 1e-5


def test_a_mirrored_trajectory_is_not_aligned_by_a_mirror() -> None:
    reference = random_poses(10)
    mirrored = reference.copy()
    mirrored[:, 0, 3] *= -1
    found = align(mirrored, reference)
    assert np.linalg.det(found.reference_from_estimate[:3, :3]) == pytest.approx(1)
    assert absolute_error(mirrored, reference).rmse_m > 0.1


def test_frames_without_truth_are_left_out_and_counted() -> None:
    reference = random_poses(9)
    estimate = reference.copy()
    reference[2], estimate[7] = np.nan, np.nan
    error, motion = absolute_error(estimate, reference), relative_error(estimate, reference)
    assert (error.frames, error.left_out) == (7, 2)
    assert np.flatnonzero(np.isnan(error.per_frame_m)).tolist() == [2, 7]
    assert error.rmse_m == pytest.approx(0, abs=1e-9)
    assert motion.translation_rmse_m == pytest.approx(0, abs=1e-9)


def test_each_component_is_aligned_apart() -> None:
    reference, moves = random_poses(10), random_poses(2, 1)
    component = np.array([0, 1] * 5)
    estimate = moves[component] @ reference
    assert absolute_error(estimate, reference, component).rmse_m == pytest.approx(0, abs=1e-9)
    assert len(absolute_error(estimate, reference, component).alignments) == 2
    assert absolute_error(estimate, reference).rmse_m > 0.1
    assert relative_error(estimate, reference, 2, component).translation_rmse_m == pytest.approx(0, abs=1e-9)
    assert np.isnan(relative_error(estimate, reference, 1, component).translation_rmse_m)


def test_a_constant_slip_is_the_relative_error() -> None:
    reference = random_poses(6)
    slip = se3.exp(np.array([0.0, 0.0, np.deg2rad(2.0), 0.0, 0.0, 0.0]))
    slip[0, 3] = 0.05
    motions = se3.inverse(reference[:-1]) @ reference[1:] @ slip
    estimate = np.stack([np.linalg.multi_dot([np.eye(4), np.eye(4), *motions[:k]]) for k in range(6)])
    error = relative_error(estimate, reference)
    assert (error.translation_rmse_m, error.rotation_rmse_deg) == pytest.approx((0.05, 2.0))


def test_nothing_to_compare_gives_nan() -> None:
    nothing = np.full((3, 4, 4), np.nan)
    error = absolute_error(nothing, random_poses(3))
    assert np.isnan([error.rmse_m, error.median_m, error.max_m]).all()
    assert error.left_out == 3
    assert np.isnan(relative_error(nothing, random_poses(3)).translation_rmse_m)
    assert np.isnan(relative_error(random_poses(1), random_poses(1)).rotation_rmse_deg)


def test_unequal_lengths_are_refused() -> None:
    with pytest.raises(GraphError, match="3 poses against 4 reference poses"):
        absolute_error(random_poses(3), random_poses(4))
    with pytest.raises(ValueError, match="delta_frames is 0"):
        relative_error(random_poses(3), random_poses(3), 0)


def test_the_shorter_list_takes_the_nearest_within_the_limit() -> None:
    stamps_a = np.array([0.0, 1.0, 1.004, 2.0, 9.0])
    stamps_b = np.array([-0.5, 0.005, 1.003, 2.02])
    rows_a, rows_b = associate(stamps_a, stamps_b, 0.01)
    assert (rows_a.tolist(), rows_b.tolist()) == ([0, 2], [1, 2])
    assert associate(stamps_a, stamps_b, 0.03)[0].tolist() == [0, 2, 3]
    assert [len(rows) for rows in associate(stamps_a, np.zeros(0))] == [0, 0]
    assert [rows.tolist() for rows in associate(np.array([1.0]), np.array([1.0]))] == [[0], [0]]
    rows_a, rows_b = associate(np.array([0.004, 1.0, 2.02]), np.array([0.0, 0.006, 0.992, 2.0]))
    assert (rows_a.tolist(), rows_b.tolist()) == ([0, 1], [1, 2]), "the longer list has the nearest of each"
