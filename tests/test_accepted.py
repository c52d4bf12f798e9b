"""Pairs that contradict odometry by more than it drifts are no edges; where it was lost it says nothing."""

from __future__ import annotations

import numpy as np
import pytest

from hodge_pipeline import se3
from hodge_pipeline.registration.acceptance import accepted, contradicts_odometry, with_odometry
from hodge_pipeline.registration.pairs import Acceptance
from hodge_pipeline.scene import Drift
from hodge_pipeline.types import Edges, Floats, Registration

POSES = se3.exp(np.arange(8)[:, None] * np.array([0.0, 0.02, 0.0, 0.1, 0.0, 0.0]))  # 0.12 of way a step
ONE = np.zeros(8, np.int64)


def registered(pairs: list[list[int]], errors: Floats) -> Edges:
    i, j = np.array(pairs).T
    motions = se3.inverse(POSES[i]) @ POSES[j] @ se3.exp(errors)
    return Edges.of(pairs).with_registrations([Registration(m, np.eye(6), 1.0, 0.01, 100, 1, True) for m in motions])


def shifted(*metres: float) -> Floats:
    return np.array([[0, 0, 0, 0, length, 0] for length in metres], float)


def test_the_longer_the_way_the_more_may_a_pair_contradict() -> None:
    found = registered([[0, 1], [0, 1], [0, 6], [0, 6]], shifted(0.04, 0.07, 0.2, 0.3))
    assert contradicts_odometry(found, Drift(POSES, ONE, 0.3)).tolist() == [False, True, False, True]
    assert not contradicts_odometry(found, Drift(POSES, ONE, 3.0)).any()


def test_a_turn_counts_as_a_way() -> None:
    turned = np.array([[0.07, 0, 0, 0, 0, 0]])
    assert contradicts_odometry(registered([[0, 1]], turned), Drift(POSES, ONE, 0.3)).tolist() == [True]
    assert contradicts_odometry(registered([[0, 3]], turned), Drift(POSES, ONE, 0.3)).tolist() == [False]


def test_where_odometry_was_lost_it_says_nothing() -> None:
    part = np.array([0, 0, 0, 1, 1, 1, 1, 1])
    found = registered([[1, 2], [2, 3], [3, 4]], shifted(9.0, 9.0, 9.0))
    assert contradicts_odometry(found, Drift(POSES, part, 0.3)).tolist() == [True, False, True]


def test_a_step_that_odometry_measured_keeps_its_measurement() -> None:
    found = registered([[0, 1], [1, 2], [2, 4]], shifted(0.0, 0.4, 0.9))
    judged = accepted(found, Acceptance(min_spread=0), Drift(POSES, ONE, 0.3))
    assert judged.status.tolist() == ["used", "rejected", "rejected"]
    odometry = registered([[0, 1], [1, 2]], shifted(0.001, 0.002)).put(slice(None), proposed_by="sequential")
    odometry = odometry.put(slice(None), information=7 * np.eye(6))
    kept = with_odometry(judged, odometry)
    assert kept.status.tolist() == ["used", "used", "rejected"] and kept.why[:2].tolist() == ["", ""]
    assert np.array_equal(kept.i_from_j[:2], [judged.i_from_j[0], odometry.i_from_j[1]])
    assert kept.information[1, 0, 0] == 7 and kept.information[0, 0, 0] == 1
    assert (
        with_odometry(judged, odometry.put(slice(None), proposed_by="image")).status.tolist() == judged.status.tolist()
    )


@pytest.mark.parametrize("scale", [0.01, 100.0])
def test_the_unit_of_length_does_not_matter(scale: float) -> None:
    found = registered([[0, 1], [0, 1]], shifted(0.04, 0.07))
    poses, motions = POSES.copy(), found.i_from_j.copy()
    poses[:, :3, 3] *= scale
    motions[:, :3, 3] *= scale
    larger = Edges.of(found.pairs).with_registrations(
        [Registration(m, np.eye(6), 1.0, 0.01, 100, 1, True) for m in motions]
    )
    assert contradicts_odometry(larger, Drift(poses, ONE, 0.3), scale).tolist() == [False, True]
