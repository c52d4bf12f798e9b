"""Candidates from drifted poses: a loop is found although its ends no longer meet."""

from __future__ import annotations

import numpy as np
import pytest

from hodge_pipeline import se3
from hodge_pipeline.pairs import drift
from hodge_pipeline.pairs.drift import DriftEdges, best_of_each
from hodge_pipeline.pairs.overlap import OverlapEdges
from hodge_pipeline.types import CloudSet, Floats, Frame, PointCloud

COUNT, RADIUS_M, SEEN_M = 80, 12.0, 4.0


def round_trip() -> Floats:
    """Poses (N, 4, 4) once round a yard and 20 frames on, the camera looking ahead."""
    angle = np.arange(COUNT) * 2 * np.pi / 60
    turned = se3.exp(np.column_stack([np.zeros((COUNT, 2)), angle, np.zeros((COUNT, 3))]))
    turned[:, :3, 3] = RADIUS_M * np.column_stack([np.sin(angle), 1 - np.cos(angle), 0 * angle])
    return turned


def drifted(poses: Floats, share: float) -> Floats:
    """The poses, as odometry would chain them with steps too long by `share` and a turn that is not there."""
    steps = se3.inverse(poses[:-1]) @ poses[1:]
    steps[:, :3, 3] *= 1 + share
    wrong = steps @ se3.exp(np.array([0, 0, 0.1 * share, 0, 0, 0]))
    out = [poses[0]]
    for step in wrong:
        out.append(out[-1] @ step)
    return np.array(out)


def yard(poses: Floats) -> CloudSet:
    """What each pose sees of posts (N, 3) scattered over the yard."""
    world = np.random.default_rng(0).uniform(-1, 1, (60_000, 3)) * [20, 20, 2] + [0, RADIUS_M, 0]
    local = [se3.transform(se3.inverse(pose), world) for pose in poses]
    return CloudSet.from_clouds([PointCloud(p[np.linalg.norm(p, axis=1) < SEEN_M].astype(np.float32)) for p in local])


def frames(sequence: str = "") -> list[Frame]:
    return [Frame(row, float(row), sequence=sequence) for row in range(COUNT)]


def closes(pairs: np.ndarray) -> int:
    return int(((pairs[:, 1] - pairs[:, 0] >= 57) & (pairs[:, 1] - pairs[:, 0] <= 63)).sum())


def test_a_loop_is_found_in_poses_that_drifted_past_overlap() -> None:
    truth = round_trip()
    clouds, poses = yard(truth), drifted(truth, 0.04)
    assert np.linalg.norm(poses[60, :3, 3] - poses[0, :3, 3]) > 2.0
    assert closes(OverlapEdges(min_iou=0.2).propose(frames(), clouds, poses).pairs) == 0
    found = DriftEdges().propose(frames(), clouds, poses)
    assert closes(found.pairs) >= 15  # of 20 frames that come by again
    assert len(found.pairs) <= 6 * COUNT and (found.pairs[:, 0] < found.pairs[:, 1]).all()
    assert (found.overlap > 0.2).all() and set(found.proposed_by.tolist()) == {"drift"}
    again = DriftEdges().propose(frames(), clouds, poses)
    assert np.array_equal(found.pairs, again.pairs)


def test_tolerance_is_none_where_nothing_may_have_drifted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(drift, "DRIFT_SHARE", 0.0001)
    truth = round_trip()
    clouds, poses = yard(truth), drifted(truth, 0.04)
    assert closes(DriftEdges().propose(frames(), clouds, poses).pairs) == 0


def test_poses_of_two_sequences_say_nothing_of_each_other() -> None:
    truth = round_trip()
    mixed = [*frames("a")[:40], *frames("b")[40:]]
    pairs = DriftEdges().propose(mixed, yard(truth), truth).pairs
    assert not ((pairs[:, 0] < 40) & (pairs[:, 1] >= 40)).any()


@pytest.mark.parametrize("count", [0, 1])
def test_a_frame_alone_has_no_pair(count: int) -> None:
    clouds = CloudSet.from_clouds([PointCloud(np.zeros((5, 3), np.float32))] * count)
    assert len(DriftEdges().propose(frames()[:count], clouds, np.tile(np.eye(4), (count, 1, 1))).pairs) == 0


def test_of_neighbours_only_the_best_is_kept() -> None:
    pairs = np.array([[0, 50], [1, 50], [2, 50], [20, 50], [40, 50]])
    kept = best_of_each(pairs, np.array([0.3, 0.6, 0.5, 0.2, 0.4]), 2, 5)
    assert pairs[kept].tolist() == [[1, 50], [40, 50]]
