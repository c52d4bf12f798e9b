"""Pairs that contradict the path of odometry, by its covariance, are no edges; a step that slid is found by others."""

from __future__ import annotations

import numpy as np
import pytest

from hodge_pipeline import se3
from hodge_pipeline.registration.acceptance import Acceptance, accepted, with_odometry
from hodge_pipeline.registration.odometry_path import contradicts_odometry, drift_of, without_slides
from hodge_pipeline.scene import Drift
from hodge_pipeline.types import Edges, Floats, Registration

POSES = se3.exp(np.arange(12)[:, None] * np.array([0.0, 0.02, 0.0, 0.1, 0.0, 0.0]))
STEPS = [[i, i + 1] for i in range(11)]
LOOPS = [[i, i + length] for length in (2, 3, 5) for i in range(12 - length)]
INFORMATION = np.diag([1 / 0.005**2] * 3 + [1 / 0.01**2] * 3)  # 5 mrad, 1 cm


def registered(pairs: list[list[int]], errors: Floats, information: Floats = INFORMATION) -> Edges:
    i, j = np.array(pairs).T
    motions = se3.inverse(POSES[i]) @ POSES[j] @ se3.exp(errors)
    return Edges.of(pairs).with_registrations([Registration(m, information, 1.0, 0.01, 100, 1, True) for m in motions])


def odometry(*lost: int, information: Floats = INFORMATION, tail: float | None = 0.01) -> Drift:
    """That of the true poses, without the steps that lead to the rows `lost`."""
    steps = [step for step in STEPS if step[1] not in lost]
    return drift_of(POSES, registered(steps, np.zeros((len(steps), 6)), information), tail)


def slid(row: int, metres: float) -> tuple[Drift, Edges]:
    """Odometry whose step to a row is off sideways, and its steps."""
    errors = np.zeros((11, 6))
    errors[row - 1, 4] = metres
    steps = registered(STEPS, errors)
    poses = POSES.copy()
    for i, j in STEPS:
        poses[j] = poses[i] @ steps.i_from_j[i]
    return drift_of(poses, steps, 0.01), steps


def shifted(*metres: float) -> Floats:
    return np.array([[0, 0, 0, 0, length, 0] for length in metres], float)


def test_the_longer_the_path_the_more_may_a_pair_contradict() -> None:
    found = registered([[0, 1], [0, 1], [0, 9], [0, 9]], shifted(0.12, 0.15, 0.25, 0.5))
    assert contradicts_odometry(found, odometry()).tolist() == [False, True, False, True]
    assert not contradicts_odometry(found, odometry(tail=None)).any()
    back = registered([[1, 0], [1, 0], [9, 0]], shifted(0.12, 0.15, 0.25))
    assert contradicts_odometry(back, odometry()).tolist() == [False, True, False]


def test_the_tail_is_the_share_of_right_pairs_that_are_lost() -> None:
    """Student's distribution of both errors, drawn as a Gaussian over the root of a chi-squared of 4 degrees."""
    rng = np.random.default_rng(0)
    wide = np.sqrt(2 * 4 / rng.chisquare(4, 4000))[:, None]
    errors = rng.normal(0, [0.005] * 3 + [0.01] * 3, (4000, 6)) * wide
    found = registered([[0, 1]] * 4000, errors)
    for tail in (0.01, 0.1):
        assert contradicts_odometry(found, odometry(tail=tail)).mean() == pytest.approx(tail, rel=0.3)


def test_where_odometry_may_slide_by_its_covariance_it_refuses_no_pair() -> None:
    loose = INFORMATION.copy()
    loose[4, 4] = 1e-3
    found = registered([[0, 1], [0, 1]], np.array([[0, 0, 0, 0, 0.5, 0], [0, 0, 0, 0.5, 0, 0]]))
    assert contradicts_odometry(found, odometry(information=loose)).tolist() == [False, True]


def test_a_turn_counts_as_a_way() -> None:
    turned = np.array([[0.08, 0, 0, 0, 0, 0]])
    assert contradicts_odometry(registered([[0, 1]], turned), odometry()).tolist() == [True]
    assert contradicts_odometry(registered([[0, 9]], turned), odometry()).tolist() == [False]


def test_where_odometry_was_lost_it_says_nothing() -> None:
    found = registered([[1, 2], [2, 3], [3, 4]], shifted(9.0, 9.0, 9.0))
    assert contradicts_odometry(found, odometry(3)).tolist() == [True, False, True]


def test_a_step_that_odometry_measured_keeps_its_measurement() -> None:
    found = registered([[0, 1], [1, 2], [2, 4]], shifted(0.0, 0.4, 0.9))
    judged, slides = accepted(found, Acceptance(min_spread=0), odometry())
    assert judged.status.tolist() == ["used", "rejected", "rejected"] and not len(slides)
    steps = registered([[0, 1], [1, 2]], shifted(0.001, 0.002)).put(slice(None), proposed_by="sequential")
    steps = steps.put(slice(None), information=7 * np.eye(6))
    kept = with_odometry(judged, steps)
    assert kept.status.tolist() == ["used", "used", "rejected"] and kept.why[:2].tolist() == ["", ""]
    assert np.array_equal(kept.i_from_j[:2], [judged.i_from_j[0], steps.i_from_j[1]])
    assert kept.information[1, 0, 0] == 7 and kept.information[0, 0, 0] == INFORMATION[0, 0]
    assert with_odometry(judged, steps.put(slice(None), proposed_by="image")).status.tolist() == judged.status.tolist()
    fitter = with_odometry(judged, steps.put(slice(None), fitness=0.8))
    assert fitter.status.tolist() == kept.status.tolist()
    assert np.array_equal(fitter.i_from_j, judged.i_from_j)


@pytest.mark.parametrize("scale", [0.01, 100.0])
def test_the_unit_of_length_does_not_matter(scale: float) -> None:
    drift, steps = slid(5, 0.3)
    pairs = STEPS + LOOPS
    found = Edges.joined(
        [registered([[0, 2], [0, 2]], shifted(0.1, 0.3)), registered(pairs, np.zeros((len(pairs), 6)))]
    )

    def in_unit(edges: Edges) -> Edges:
        return edges.put(
            slice(None),
            i_from_j=se3.rescaled(edges.i_from_j, scale),
            information=se3.rescaled_information(edges.information, scale),
        )

    larger = drift_of(se3.rescaled(drift.world_from_cam, scale), in_unit(steps), 0.01)
    assert contradicts_odometry(in_unit(found), larger).tolist() == contradicts_odometry(found, drift).tolist()
    assert without_slides(in_unit(found), larger)[1].tolist() == without_slides(found, drift)[1].tolist() == [5]


@pytest.mark.parametrize("row", [1, 5, 11])
def test_a_step_that_slid_unnoticed_is_mended_as_the_pairs_over_it_agree(row: int) -> None:
    drift, _ = slid(row, 0.3)
    found = registered(STEPS + LOOPS, np.zeros((len(STEPS + LOOPS), 6)))
    assert contradicts_odometry(found, drift).any()
    mended, rows = without_slides(found, drift)
    assert rows.tolist() == [row] and not contradicts_odometry(found, mended).any()
    motion, truth = (se3.inverse(poses[0]) @ poses[11] for poses in (mended.world_from_cam, POSES))
    np.testing.assert_allclose(motion, truth, atol=1e-9)
    judged, told = accepted(found, Acceptance(min_spread=0), drift)
    assert (judged.status == "used").all() and told.tolist() == [row]


def test_places_that_look_alike_do_not_break_odometry() -> None:
    """All pairs of two steps and more agree that the far end lies elsewhere; the step itself says that it does not."""
    alike = registered(STEPS + LOOPS, np.zeros((len(STEPS + LOOPS), 6)))
    over = (alike.pairs[:, 0] < 5) & (alike.pairs[:, 1] >= 5) & (np.diff(alike.pairs, axis=1)[:, 0] > 1)
    elsewhere = POSES.copy()
    elsewhere[5:] = se3.exp(np.array([0, 0, 0, 0.0, 0.5, 0.0])) @ elsewhere[5:]
    i, j = alike.pairs.T
    wrong = se3.inverse(elsewhere[i]) @ elsewhere[j]
    alike = alike.put(slice(None), i_from_j=np.where(over[:, None, None], wrong, alike.i_from_j))
    drift, rows = without_slides(alike, odometry())
    assert not len(rows) and (contradicts_odometry(alike, drift) == over).all()


def test_two_pairs_that_agree_are_not_enough() -> None:
    drift, _ = slid(5, 0.3)
    assert without_slides(registered([[4, 5], [4, 6]], np.zeros((2, 6))), drift)[1].tolist() == []
    assert without_slides(registered([[4, 5], [4, 6], [3, 5]], np.zeros((3, 6))), drift)[1].tolist() == [5]
