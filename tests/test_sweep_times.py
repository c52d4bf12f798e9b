"""When points of sweeps were measured: times told, backwards, by their order, or of sweeps deskewed before."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from hodge_pipeline import se3
from hodge_pipeline.demo.street import Road
from hodge_pipeline.demo.sweeps import FARTHEST_M, REVOLUTION_S, SpinningScanner
from hodge_pipeline.evaluation.trajectory import absolute_error
from hodge_pipeline.registration import following, scan_to_map
from hodge_pipeline.registration.clouds import CloudOptions
from hodge_pipeline.registration.sweeps import (
    BACKWARDS,
    FORWARDS,
    UNUSED,
    deskewed,
    turned,
    turns_by_order,
    velocities_along,
)
from hodge_pipeline.stages import Steps
from hodge_pipeline.start.sweep_reading import Look
from hodge_pipeline.start.sweep_times import deskewed_along, times_along
from hodge_pipeline.types import Floats, PointCloud, Source
from hodge_pipeline.types.notes import Note
from hodge_pipeline.uses.trajectory import refine_trajectory
from lidar_worlds import CarFree
from street_sweeps import (
    COUNT,
    JUDGE,
    NEAR_M,
    SPEED_M_S,
    UNIX_S,
    Sweeping,
    changed,
    corner,
    followed,
    frames_of,
    street,
    street_followed,
    true_at,
    true_poses,
    warm_up_once,  # noqa: F401 - a fixture
    without_order,
)

FAST, FAST_M_S = 24, 20.0


@pytest.fixture
def times_judged(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(JUDGE, following.sense_of_times)


def test_sweeps_of_given_poses_are_deskewed_by_them() -> None:
    frames = corner()
    exact = true_at([frame.stamp_s - UNIX_S for frame in frames])
    noise = np.random.default_rng(0).normal(0, [5e-4] * 3 + [0.04] * 3, (len(frames), 6))
    given = exact @ se3.exp(np.cumsum(noise, axis=0))
    refined = refine_trajectory(given, frames, overrides=["recording.level=off", "executor.workers=0"])
    assert not refined.decision.keeps_input
    before, after = (absolute_error(poses, exact).rmse_m for poses in (given, refined.poses))
    assert after < 0.75 * before  # skewed around a corner, they fit each other where the scanner was not


@pytest.mark.usefixtures("times_judged")
def test_backward_times_of_sweeps_with_given_poses_are_turned_and_named() -> None:
    notes = list[Note]()
    steps = cast(Steps, SimpleNamespace(note=notes.append))
    poses, right = Road(FAST_M_S).world_from_car(np.arange(FAST) * REVOLUTION_S), frames_of(fast_sweeps())
    source = Source("sweeps", Path("sweeps"), tuple(changed(frame, turned) for frame in right))
    made = deskewed_along(source, poses, CloudOptions(max_range_m=FARTHEST_M), steps)
    assert [note.kind for note in notes] == ["times backwards"]
    got, own = made.frames[12].read_points, right[12].read_points
    assert got is not None and own is not None
    here, behind = poses[12:14]
    exact = deskewed(own(), se3.log(se3.inverse(here) @ behind) / REVOLUTION_S).points_in_cam
    assert np.abs(got().points_in_cam - exact).max() < 0.02 < np.abs(own().points_in_cam - exact).max()


@pytest.mark.parametrize(("noise_m", "most_m"), [(0.0, 0.01), (0.005, 0.05), (0.1, 0.6)])
def test_velocities_of_sweeps_are_as_even_as_their_poses_are_noisy(noise_m: float, most_m: float) -> None:
    """RMS displacement within a sweep at 30 m, of a car that wobbles: medians over a second are 0.26 m off, those of
    single steps 0.04 and 0.83 m with noise."""
    times, reach_m = REVOLUTION_S * np.arange(60), 30.0
    poses = true_poses(np.arange(61))
    true = se3.log(se3.inverse(poses[:-1]) @ poses[1:]) / REVOLUTION_S
    noise = np.random.default_rng(0).normal(size=(60, 6)) * np.repeat([np.radians(6.0), 1.0], 3) * noise_m
    found = velocities_along(poses[:-1] @ se3.exp(noise), times, times + REVOLUTION_S / 2, reach_m)
    off_m = REVOLUTION_S * (found - true)[:-1] * np.repeat([reach_m, 1.0], 3)
    assert np.sqrt((off_m**2).sum(axis=1).mean()) < most_m


def test_sweeps_take_the_velocity_of_the_time_they_were_measured_in() -> None:
    times = REVOLUTION_S * np.arange(30)
    poses = np.tile(np.eye(4), (30, 1, 1))
    poses[:, 0, 3] = times**2
    for late_s in (0.0, REVOLUTION_S / 2):
        found = velocities_along(poses, times, times + late_s, 30.0)[5:-5, 3]
        np.testing.assert_allclose(found, 2 * (times[5:-5] + late_s), atol=1e-6)


@pytest.mark.parametrize(("apart_s", "told"), [(0.1, ["sweeps untimed"]), (30.0, [])])
def test_given_poses_of_sweeps_without_times_are_told_and_those_of_stations_are_not(
    apart_s: float, told: list[str]
) -> None:
    frames = [
        changed(replace(frame, stamp_s=UNIX_S + row * apart_s), without_order) for row, frame in enumerate(corner()[:4])
    ]
    source, notes = Source("sweeps", Path("sweeps"), tuple(frames)), list[Note]()
    steps = cast(Steps, SimpleNamespace(note=notes.append))
    assert deskewed_along(source, np.tile(np.eye(4), (4, 1, 1)), CloudOptions(), steps) is source
    assert [note.kind for note in notes] == told


def test_times_that_run_backwards_are_turned_in_all_sweeps_and_named(monkeypatch: pytest.MonkeyPatch) -> None:
    right, _ = street_followed()
    monkeypatch.setattr(JUDGE, lambda *_: BACKWARDS)
    found, said = followed([changed(frame, turned) for frame in street()])
    assert "seem to run backwards" in said and "24 of 24 sweeps" in said and (found.sense == BACKWARDS).all()
    np.testing.assert_allclose(found.world_from_scan, right.world_from_scan, atol=1e-3)


@dataclass(frozen=True)
class Turning(CarFree):
    """A walk that begins in a turn of 90 degrees a second."""

    length_m: float = 1e9

    def world_from_car(self, times_s: Floats) -> Floats:
        """Poses (N, 4, 4)."""
        t = np.asarray(times_s, float)
        position = np.stack([-60 + 2 * t, -52 + 0 * t, 1.9 + 0 * t], axis=1)
        return se3.from_parts(se3.so3_exp(np.stack([0 * t, 0 * t, np.pi / 2 * t], axis=1)), position)


@pytest.mark.usefixtures("times_judged")
def test_a_turn_from_the_first_sweep_on_is_followed() -> None:
    own = SpinningScanner(cast(Road, Turning()), 0, beams=16, columns=360, noise=1.0)
    found, _ = followed(frames_of([own.sweep(number) for number in range(COUNT)]))
    assert (found.sense == FORWARDS).all()
    exact = Turning().world_from_car(np.arange(COUNT) * REVOLUTION_S)
    assert absolute_error(found.world_from_scan, exact).max_m < NEAR_M


@cache
def fast_sweeps() -> list[object]:
    """Revolutions along a street, fast."""
    scanner = SpinningScanner(Road(FAST_M_S), 0, beams=16, columns=360, noise=1.0)
    return [scanner.sweep(number) for number in range(FAST)]


def fast_street() -> list[PointCloud]:
    """The first half of these."""
    return [PointCloud(sweep.points, times_s=sweep.times_s) for sweep in fast_sweeps()[: FAST // 2]]


def test_sweeps_that_leave_the_motion_loose_judge_no_times(monkeypatch: pytest.MonkeyPatch) -> None:
    """As a narrow field in a corridor: paths slide, and points lie on the map by chance."""
    given = [(row, row * REVOLUTION_S, turned(cloud)) for row, cloud in enumerate(fast_street())]
    place = scan_to_map.ScanToMap.place

    def loose(tracker: scan_to_map.ScanToMap, cloud: PointCloud, time_s: float) -> scan_to_map.Step:
        return place(tracker, cloud, time_s)._replace(is_loose=time_s > 0.7)

    monkeypatch.setattr(scan_to_map.ScanToMap, "place", loose)
    assert following.sense_of_times(0.5, np.array([0, 0, 0, 20.0, 0, 0]), FORWARDS, given) == FORWARDS


def test_times_that_run_backwards_or_are_of_deskewed_points_are_told_by_the_points_on_the_map(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    placed, shown = list[float](), list[int]()
    place = scan_to_map.ScanToMap.place

    def counted(tracker: scan_to_map.ScanToMap, cloud: PointCloud, time_s: float) -> scan_to_map.Step:
        placed.append(time_s)
        return place(tracker, cloud, time_s)

    monkeypatch.setattr(scan_to_map.ScanToMap, "place", counted)
    right = fast_street()
    velocity = np.array([0, 0, 0, 20.0, 0, 0])
    flat = [replace(cloud, points_in_cam=deskewed(cloud, velocity).points_in_cam) for cloud in right]
    for clouds, sense in ((right, FORWARDS), ([turned(cloud) for cloud in right], BACKWARDS), (flat, UNUSED)):
        given = [(row, row * REVOLUTION_S, cloud) for row, cloud in enumerate(clouds)]
        placed.clear()
        shown.clear()
        assert following.sense_of_times(0.5, velocity, FORWARDS, given, shown.append) == sense
        assert not sum(shown) and shown.count(1) > 2  # the bar moves, and ends where it was
        assert (len(placed) < 2 * len(given)) == (clouds is right)  # no more are asked once they are surely worse
        if clouds is right:  # as of times by the order of points
            assert following.sense_of_times(0.5, velocity, UNUSED, given) == sense


@pytest.mark.parametrize(
    ("judged", "sense"),
    [([UNUSED, FORWARDS], FORWARDS), ([FORWARDS], FORWARDS), ([UNUSED, BACKWARDS], FORWARDS), ([UNUSED] * 2, UNUSED)],
)
def test_other_times_are_taken_only_where_the_two_fastest_parts_are_sure_of_the_same(
    judged: list[int], sense: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    frames, times = 3 * street()[:20], np.arange(60) * REVOLUTION_S
    velocity = np.outer(np.repeat([1.0, 3.0, 2.0], 20), [0, 0, 0, 1.0, 0, 0])
    answers, asked = iter(judged), list[float]()

    def judge(_: float, of: Floats, __: int, sweeps: Sweeping, *___: object) -> int:
        asked.append(of[3])
        assert [at for _, at, _ in sweeps] == times[20 * (4 - int(of[3])) % 60 :][:20].tolist()
        return next(answers)

    monkeypatch.setattr(JUDGE, judge)
    look = Look(50.0, REVOLUTION_S, 0.0)
    assert times_along(frames, velocity, times, CloudOptions(max_range_m=FARTHEST_M), 0.5, look) == (0.0, sense)
    assert asked == [3.0, 2.0][: len(judged)]


def test_the_order_of_points_tells_how_a_scanner_spun_and_no_other_order_does() -> None:
    read = street()[3].read_points
    assert read is not None
    cloud = read()
    assert cloud.times_s is not None
    points, turns = cloud.points_in_cam, cloud.times_s / REVOLUTION_S
    got = turns_by_order(points)
    assert got is not None and np.abs(got - got[0] - (turns - turns[0])).max() < 0.02
    lost = (turns < 0.3) | (turns > 0.55)
    got = turns_by_order(points[lost])
    assert got is not None and np.quantile(np.abs(got - (turns - turns[0])[lost]), 0.99) < 0.02
    rings = np.argsort(np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1])).round(3), kind="stable")
    for order in (rings, np.argsort(points[:, 0]), np.random.default_rng(0).permutation(len(points))):
        assert turns_by_order(points[order]) is None
    assert turns_by_order(points[turns < 0.3]) is None  # such as the columns of a camera's image


def untimed(cloud: PointCloud) -> PointCloud:
    return replace(cloud, times_s=None)


def test_points_without_times_are_deskewed_by_their_order_where_the_map_is_sure_of_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    frames = [changed(frame, untimed) for frame in street()]
    judged = list[tuple[int, int]]()

    def sure(_: float, __: Floats, told: int, sweeps: Sweeping, *___: object) -> int:
        judged.append((told, len(sweeps)))
        return FORWARDS

    monkeypatch.setattr(JUDGE, sure)
    found, said = followed(frames)
    assert judged == 2 * [(UNUSED, COUNT // 2)]
    assert "points of 24 of 24 sweeps have no times" in said and "their times are told by it" in said
    assert absolute_error(found.world_from_scan, true_poses(range(COUNT))).max_m < NEAR_M
    right, _ = street_followed()
    np.testing.assert_allclose(found.velocity, right.velocity, atol=0.3)


@pytest.mark.usefixtures("times_judged")
def test_points_deskewed_before_stay_as_they_are_and_poses_are_those_without_an_order() -> None:
    velocity = np.array([0, 0, 0, SPEED_M_S, 0, 0])
    flat = [changed(frame, lambda cloud: deskewed(cloud, velocity)) for frame in street()]
    found, said = followed(flat)
    assert "each is taken as measured in an instant" in said and not found.revolution_s.any()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("hodge_pipeline.start.sweep_reading.turns_by_order", lambda _: None)
        unordered, _ = followed(flat)
    np.testing.assert_array_equal(found.world_from_scan, unordered.world_from_scan)
