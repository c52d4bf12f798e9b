"""A camera's path, smoothed: noise is taken out of it, and nothing else."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hodge_pipeline import se3
from hodge_pipeline.registration.tracking.smoothing import smoothed
from hodge_pipeline.rounds.all_frames import _smooth
from hodge_pipeline.scene import KeyFrames
from hodge_pipeline.types import Floats

SIGMA = np.repeat([0.001, 0.002], 3)
COUNT = 200


def true_path(hz: float = 30.0, count: int = COUNT) -> tuple[Floats, Floats]:
    """A hand's poses (count, 4, 4) and times: it sways at up to 1.3 Hz, by some 10 cm and 10°."""
    times, rng = np.arange(count) / hz, np.random.default_rng(5)
    waves = rng.uniform(0.2, 1.3, (6, 3)), rng.uniform(0, 6, (6, 3)), rng.normal(0, 0.04, (6, 3))
    swayed = sum(np.sin(2 * np.pi * times[:, None] * f + p) * a for f, p, a in zip(*(w.T for w in waves), strict=True))
    return np.asarray(se3.from_parts(se3.so3_exp(2 * swayed[:, :3]), swayed[:, 3:])), times


def noisy(poses: Floats, seed: int = 0, sigma: Floats = SIGMA) -> Floats:
    return np.asarray(poses @ se3.exp(np.random.default_rng(seed).normal(size=(len(poses), 6)) * sigma))


def errors(poses: Floats, truth: Floats) -> tuple[float, float]:
    """RMS of translation in metres and of rotation in radians."""
    off = se3.log(se3.inverse(truth) @ poses)
    return tuple(float(np.sqrt((off[:, part] ** 2).sum(axis=1).mean())) for part in (slice(3, 6), slice(0, 3)))


def information(count: int = COUNT) -> Floats:
    return np.broadcast_to(np.diag(1 / SIGMA**2), (count, 6, 6))


@pytest.mark.parametrize("factor", [0.01, 1.0, 100.0])
def test_noise_is_taken_out_however_large_it_is_stated_to_be(factor: float) -> None:
    truth, times = true_path()
    before = noisy(truth)
    after = smoothed(before, factor * information(), times)
    (shift, turn), (shift_before, turn_before) = errors(after, truth), errors(before, truth)
    assert shift < 0.7 * shift_before
    assert turn < 0.8 * turn_before


@pytest.mark.parametrize("hz", [30.0, 10.0, 5.0])
def test_a_path_without_noise_stays(hz: float) -> None:
    truth, times = true_path(hz)
    shift, turn = errors(smoothed(truth, information(), times), truth)
    assert shift < 1e-4
    assert turn < 1e-4


def test_a_blurred_frame_is_put_right_and_its_neighbours_stay() -> None:
    truth, times = true_path()
    before = noisy(truth)
    before[100] = before[100] @ se3.exp(np.array([[0.02, -0.02, 0, 0.05, 0, 0.03]]))[0]
    after = smoothed(before, information(), times)
    assert errors(after[100:101], truth[100:101])[0] < 0.006
    assert errors(after, truth)[0] < 0.7 * errors(noisy(truth), truth)[0]


def test_rotation_is_put_right_by_what_it_shares_with_translation() -> None:
    """Far points tell a turn from a shift badly: where the shift is put right, the turn is too."""
    truth, times = true_path()
    rng, mixed = np.random.default_rng(1), np.diag(SIGMA**2 / 100)
    way = np.array([0, 0.004, 0, 0.008, 0, 0])
    noise = rng.normal(size=(COUNT, 1)) * way + rng.normal(size=(COUNT, 6)) * SIGMA / 10
    before = truth @ se3.exp(noise)
    told = np.broadcast_to(np.linalg.inv(mixed + np.outer(way, way)), (COUNT, 6, 6))
    assert errors(smoothed(before, told, times), truth)[1] < 0.4 * errors(before, truth)[1]


def test_a_camera_at_rest_stays() -> None:
    still = np.broadcast_to(np.eye(4), (COUNT, 4, 4)).copy()
    np.testing.assert_allclose(smoothed(still, information(), np.arange(COUNT) / 30), still, atol=1e-9)


def test_the_unit_of_length_is_of_no_account() -> None:
    truth, times = true_path()
    before = noisy(truth)
    metres = smoothed(before, information(), times)
    told = se3.rescaled_information(information().copy(), 1000.0)
    millimetres = smoothed(se3.rescaled(before, 1000.0), told, times)
    np.testing.assert_allclose(se3.rescaled(millimetres, 1 / 1000.0), metres, atol=1e-6)


def key_frames(poses: Floats, times: Floats) -> KeyFrames:
    every, zeros = np.arange(len(poses)), np.zeros(len(poses), np.int64)
    return KeyFrames(every, poses, poses, zeros, times, np.ones(len(poses), bool), times, zeros, every)


def test_runs_are_smoothed_apart_and_lost_frames_left() -> None:
    """A jump between two sequences, or after a pause, is no acceleration."""
    truth, times = true_path()
    before = noisy(truth)
    before[80:, :3, 3] += 5.0
    times = times + 3600.0 * (np.arange(COUNT) >= 140)
    followed = key_frames(before, times)
    followed = replace(followed, sequence=(np.arange(COUNT) >= 80).astype(np.int64))
    followed.found[150] = False
    after = _smooth(before, information().copy(), times, followed)
    for run in (slice(0, 80), slice(80, 140)):
        np.testing.assert_allclose(after[run], smoothed(before[run], information()[run], times[run]), atol=1e-12)
    np.testing.assert_array_equal(after[150], before[150])


@pytest.mark.parametrize("step_s", [0.3, 1.0, 0.0])
def test_what_is_no_video_stays(step_s: float) -> None:
    truth, _ = true_path()
    before, times = noisy(truth), np.arange(COUNT) * step_s
    np.testing.assert_array_equal(_smooth(before, information().copy(), times, key_frames(before, times)), before)


def test_frames_that_were_not_posed_anew_err_as_is_usual() -> None:
    truth, times = true_path()
    before, told = noisy(truth), information().copy()
    told[::5] = 0.0
    np.testing.assert_allclose(
        _smooth(before, told, times, key_frames(before, times)), smoothed(before, information(), times), atol=1e-12
    )


def test_three_frames_stay() -> None:
    truth, times = true_path(count=3)
    before = noisy(truth)
    np.testing.assert_array_equal(smoothed(before, information(3), times), before)


def test_the_usual_error_of_frames_that_see_in_one_direction_each_is_one() -> None:
    """The medians of the entries of their information are those of no error: an eigenvalue is negative."""
    truth, times = true_path()
    before, told = noisy(truth), information().copy()
    for row, seen in enumerate(np.array([[1.0, 1, 1], [1, 1, -1], [1, -1, 1]])):
        told[row::3, 3:, 3:] = 1e6 * np.outer(seen, seen) + 1e3 * np.eye(3)
    told[::5] = 0.0
    assert errors(_smooth(before, told, times, key_frames(before, times)), truth)[1] < errors(before, truth)[1]
