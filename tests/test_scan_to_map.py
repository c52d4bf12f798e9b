"""The tracker of sweeps: its filter of velocities, how it deskews, and when an alignment tells little."""

from __future__ import annotations

from collections.abc import Callable
from typing import cast

import numpy as np
import pytest

from hodge_pipeline import se3
from hodge_pipeline.demo.sweeps import REVOLUTION_S
from hodge_pipeline.registration import scan_to_map
from hodge_pipeline.registration.scan_to_map import ScanToMap
from hodge_pipeline.registration.scan_to_map import Step as Placed
from hodge_pipeline.registration.sweep_map import SweepMap
from hodge_pipeline.types import Floats, PointCloud
from lidar_worlds import scanner_in
from street_sweeps import NEAR_M, SPEED_M_S, street


def test_a_sweep_that_cannot_be_aligned_tells_nothing_of_how_far_the_scanner_went() -> None:
    clouds = [cast(Callable[[], PointCloud], frame.read_points)() for frame in street()[:4]]
    clouds[2] = PointCloud(clouds[2].points_in_cam[:3])
    tracker, loose = ScanToMap(0.5, np.array([0, 0, 0, SPEED_M_S, 0, 0])), []
    for number, cloud in enumerate(clouds):
        tracker.follow(cloud, number * REVOLUTION_S)
        loose.append(tracker.is_loose)
    assert loose == [False, False, True, False]


def test_two_sweeps_of_one_stamp_tell_nothing_of_the_velocity() -> None:
    tracker = ScanToMap(0.8, np.array([0, 0, 0, SPEED_M_S, 0, 0]))
    clouds = [cast(Callable[[], PointCloud], street()[row].read_points)() for row in (0, 1)]
    tracker.follow(clouds[0], 0.0)
    tracker.follow(clouds[1], REVOLUTION_S)
    assert tracker.place(clouds[1], REVOLUTION_S).weak == pytest.approx(np.eye(3))


def test_coarse_voxels_align_only_sweeps_that_fit_less_than_usual_where_they_are_predicted(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    tracker, aligned = ScanToMap(0.8, np.array([0, 0, 0, SPEED_M_S, 0, 0])), list[int]()
    coarse = SweepMap._coarse
    monkeypatch.setattr(SweepMap, "_coarse", lambda *given: (aligned.append(row), coarse(*given))[1])
    for row in (0, 1, 2, 3, 4, 5, 6, 7, 8, 14):
        cloud = cast(Callable[[], PointCloud], street()[row].read_points)()
        tracker.follow(cloud, row * REVOLUTION_S)
    assert set(aligned) == {1, 2, 3, 14}  # before it is known how well sweeps fit; a sweep that fits less well
    assert tracker.pose[0, 3] == pytest.approx(14 * SPEED_M_S * REVOLUTION_S, abs=NEAR_M)


@pytest.mark.parametrize("is_timed", [True, False])
def test_after_a_hole_a_start_at_rest_counts_by_all_points_and_by_the_motion_so_far(is_timed: bool) -> None:
    own = scanner_in("field", 2)  # whose rings fit each other wherever they are
    exact = own.road.world_from_car((np.arange(20) + 0.5) * REVOLUTION_S)
    tracker = ScanToMap(0.66, se3.log(se3.inverse(exact[8]) @ exact[9]) / REVOLUTION_S)
    poses = []
    for row in (8, 9, 10, 11, 16):
        sweep = own.sweep(row)
        tracker.follow(PointCloud(sweep.points, times_s=sweep.times_s if is_timed else None), row * REVOLUTION_S)
        poses.append(tracker.pose)
    moved, right = se3.inverse(poses[-2]) @ poses[-1], se3.inverse(exact[11]) @ exact[16]
    assert np.linalg.norm((se3.inverse(right) @ moved)[:3, 3]) < 0.3  # at rest 1.8 and 2.4 m off


def test_a_turn_on_the_spot_that_ends_within_a_sweep_goes_no_further() -> None:
    own, rows = scanner_in("office", 4), np.arange(16, 58)
    exact = own.road.world_from_car((rows + 0.5) * REVOLUTION_S)
    tracker = ScanToMap(0.218, se3.log(se3.inverse(exact[0]) @ exact[1]) / REVOLUTION_S)
    for row in rows:
        tracker.follow(PointCloud((sweep := own.sweep(row)).points, times_s=sweep.times_s), row * REVOLUTION_S)
    off = se3.log(se3.inverse(se3.inverse(exact[0]) @ exact[-1]) @ tracker.pose)
    assert np.degrees(np.linalg.norm(off[:3])) < 1.0  # 6.6, where it is deskewed by the turn alone
    assert np.linalg.norm(off[3:]) < 0.05


def test_a_velocity_beyond_those_of_sweeps_that_held_goes_back_where_the_alignment_tells_less() -> None:
    """As along like panels of a corridor, where an office of 900 sweeps slid by half a metre a sweep."""
    tracker, ahead, few = ScanToMap(0.2, np.zeros(6)), np.eye(6)[3], PointCloud(np.ones((1, 3), np.float32))

    def after(velocity: Floats, weak: Floats) -> Floats:
        tracker.accept(Placed(np.eye(4), 0.0, velocity, np.eye(3), 0.1, False, 1.0, weak, np.zeros(3)))
        return tracker.place(few, REVOLUTION_S).velocity

    for speed in (1.0, 2.0) * 5:
        after(speed * ahead, np.zeros((3, 3)))
    beyond, along = 6.0 * ahead + np.eye(6)[4], np.diag([1.0, 0, 0])
    np.testing.assert_array_equal(after(1.5 * ahead, along), 1.5 * ahead)
    _, _, _, forwards, left, _ = after(beyond, along)
    assert 4.5 < forwards < 5.5 and left == 1.0
    np.testing.assert_array_equal(after(beyond, np.zeros((3, 3))), beyond)


@pytest.mark.parametrize(("has_end", "weak"), [(False, np.diag([1.0, 0, 0])), (True, np.zeros((3, 3)))])
def test_an_alignment_tells_less_than_the_motion_so_far_along_bare_walls_alone(has_end: bool, weak: Floats) -> None:
    rng, tracker = np.random.default_rng(0), ScanToMap(0.2, np.zeros(6))

    def corridor() -> PointCloud:
        points = rng.uniform([-12, -1.5, -1.5], [12, 1.5, 1.5], (8000, 3))
        first, side = 500 * has_end, rng.integers(0, 4, 8000)
        points[np.arange(first, 8000), 1 + side[first:] % 2] = np.where(side[first:] < 2, -1.5, 1.5)
        points[:first, 0] = 8.0
        return PointCloud((points + rng.normal(0, 0.01, (8000, 3))).astype(np.float32))

    for row in range(3):
        tracker.follow(corridor(), row * REVOLUTION_S)
    np.testing.assert_allclose(tracker.place(corridor(), 3 * REVOLUTION_S).weak, weak, atol=0.05)


def test_a_sweep_that_turns_on_joins_the_map_as_it_was_aligned_so(monkeypatch: pytest.MonkeyPatch) -> None:
    """The trial without the turn, which fits worse here, leaves nothing behind."""
    tracker = ScanToMap(0.2, np.array([0, 0, 1.0, 0, 0, 0]))
    tracker._usual.extend(10 * [1.0])

    def placed(_: PointCloud, __: float, velocity: Floats) -> Placed:
        tracker._map.latest = tracker._map.latest._replace(share=float(velocity[2]))
        return Placed(
            np.eye(4), 0.0, velocity, np.eye(3), 0.1, False, 0.5 + 0.1 * velocity[2], np.zeros((3, 3)), np.zeros(3)
        )

    monkeypatch.setattr(tracker, "_placed", placed)
    assert tracker.place(PointCloud(np.zeros((0, 3), np.float32)), 0.0).on_map == 0.6
    assert tracker._map.latest.share == 1.0


@pytest.mark.parametrize(
    ("next_turn", "most_on_map", "turn", "rounds"),
    [
        pytest.param(lambda turn: 1 + turn / 2, 0.0, 1.9375, 5, id="settles slowly"),
        pytest.param(lambda turn: 2 - 1.1 * turn, 0.0, -0.2, 2, id="alternates, the last round fits"),
        pytest.param(lambda turn: 2 - 1.1 * turn, 2.0, 2.0, 2, id="alternates, the first round fits"),
    ],
)
def test_a_sweep_is_deskewed_until_its_turn_settles_or_the_best_round_stands_where_it_swings(
    next_turn: Callable[[float], float], most_on_map: float, turn: float, rounds: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`next_turn`: the turn found by that it was deskewed by, radians a second; points are 20 m away."""
    tracker, rates = ScanToMap(0.2, np.zeros(6)), list[float]()
    tracker.accept(
        Placed(np.eye(4), -REVOLUTION_S, np.zeros(6), 1e-6 * np.eye(3), 0.1, False, 1.0, np.zeros((3, 3)), np.zeros(3))
    )
    cloud = PointCloud(np.full((9, 3), 20 / np.sqrt(3), np.float32), times_s=np.linspace(0, 0.1, 9, dtype=np.float32))

    def deskewed_by(cloud: PointCloud, rate: Floats, _: float) -> PointCloud:
        rates.append(float(rate[2]))
        return cloud

    def align(*_: object) -> tuple[Floats, Floats]:
        found = next_turn(rates[-1])
        tracker._map.latest = tracker._map.latest._replace(share=found)
        return se3.exp(np.eye(6)[2] * found * REVOLUTION_S), 1e6 * np.eye(6)

    monkeypatch.setattr(scan_to_map, "deskewed", deskewed_by)
    monkeypatch.setattr(tracker._map, "align", align)
    monkeypatch.setattr(
        tracker._map, "share_at", lambda pose: 1 - abs(se3.log(pose)[2] / REVOLUTION_S - most_on_map) / 9
    )
    assert tracker.place(cloud, 0.0).velocity[2] == pytest.approx(turn, abs=1e-3)
    assert len(rates) == rounds
    assert tracker._map.latest.share == pytest.approx(turn, abs=1e-3)
