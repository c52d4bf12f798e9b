"""Sequences of sweeps with holes, copies, odd clocks and units: followed all the same, and said."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from hodge_adapters.clouds.ply import write_ply
from hodge_adapters.clouds.reader import CloudFolderReader
from hodge_pipeline import se3
from hodge_pipeline.cli.list import next_command
from hodge_pipeline.demo.street import Road
from hodge_pipeline.demo.sweeps import FARTHEST_M, REVOLUTION_S, SpinningScanner
from hodge_pipeline.errors import SourceError
from hodge_pipeline.evaluation.trajectory import absolute_error
from hodge_pipeline.registration.clouds import CloudOptions
from hodge_pipeline.registration.sweeps import (
    deskewed,
    deskewed_frame,
)
from hodge_pipeline.sources.frame_facts import frame_facts
from hodge_pipeline.start.sweeps import Sweeps, _jumps, key_rows, thickened
from hodge_pipeline.types import Floats, Frame, PointCloud, Source
from street_sweeps import (
    COUNT,
    NEAR_M,
    SPEED_M_S,
    UNIX_S,
    changed,
    corner,
    followed,
    street,
    street_followed,
    true_at,
    true_poses,
    warm_up_once,  # noqa: F401 - a fixture
    without_order,
)


def broken(cloud: PointCloud) -> PointCloud:
    raise SourceError("cut off")


def test_sweeps_after_unread_ones_are_followed() -> None:
    frames, lost = street().copy(), 5
    frames[12 : 12 + lost] = [changed(frame, broken) for frame in frames[12 : 12 + lost]]
    found, said = followed(frames)
    assert found.found.sum() == COUNT - lost and "12.pcd: the sweep is left out: cut off" in said
    rows = np.flatnonzero(found.found)
    assert absolute_error(found.world_from_scan[rows], true_poses(rows)).max_m < NEAR_M
    assert np.linalg.norm(found.velocity[rows, 3:], axis=1) == pytest.approx(SPEED_M_S, abs=0.5)


@pytest.mark.parametrize(
    ("clock", "is_timed"), [("numbers", True), ("seconds", False), ("milliseconds from the first", True)]
)
def test_sweeps_after_a_hole_are_followed(clock: str, is_timed: bool) -> None:
    stamp = {"numbers": (0.0, 1.0), "seconds": (UNIX_S, REVOLUTION_S)}.get(clock, (0.0, 100.0))
    frames = [replace(frame, stamp_s=stamp[0] + stamp[1] * frame.stamp_s) for frame in street()]
    if not is_timed:
        frames = [changed(frame, lambda cloud: replace(cloud, times_s=None)) for frame in frames]
    rows = [number for number in range(COUNT) if not 12 <= number < 17]
    found, _ = followed([frames[row] for row in rows])
    assert absolute_error(found.world_from_scan, true_poses(rows)).max_m < NEAR_M


def test_a_sweep_off_the_even_motion_around_it_is_named() -> None:
    frames, side = street().copy(), np.array([0, 0.4, 0], np.float32)
    frames[13] = changed(frames[13], lambda cloud: replace(cloud, points_in_cam=cloud.points_in_cam + side))
    _, said = followed(frames)
    assert "the path jumps at 1 sweep" in said and "(13.pcd: 0.3" in said
    assert "jumps" not in street_followed()[1]


@pytest.mark.parametrize("step_s", [0.1, 0.2, 0.5])
def test_braking_is_even_motion_and_a_displaced_pose_is_not(step_s: float) -> None:
    rows = np.append(np.arange(20), np.arange(24, 40))  # with a hole
    times, names = rows * step_s, list(map(str, rows))
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    braking = np.clip(times - times[8], 0, 2.0)
    poses[:, 0, 3] = 20 * times - 9 / 2 * braking**2 - 18 * np.maximum(times - times[8] - 2.0, 0)
    poses[:, 1, 3] = 0.005 * (-1.0) ** np.arange(len(times))
    assert _jumps(names, poses, times, 0.5) == []
    poses[14, 1, 3] += 12 * step_s**2 + 0.1
    assert [name.split(":")[0] for name in _jumps(names, poses, times, 0.5)] == ["14"]


@pytest.mark.parametrize(
    ("first_s", "is_last"),
    [(-REVOLUTION_S, True), (UNIX_S, True), (5000.0, False)],
    ids=["after the last point", "unix, of the last point", "another clock"],
)
def test_poses_are_those_at_the_stamps(first_s: float, is_last: bool) -> None:
    late_s, frames = REVOLUTION_S * is_last, corner()
    begins_s = np.array([frame.stamp_s for frame in frames]) - UNIX_S
    own_s = first_s + begins_s * (first_s > 0)
    clocked = [
        changed(replace(frame, stamp_s=frame.stamp_s + late_s), lambda cloud, s=s: replace(cloud, first_s=s))
        for frame, s in zip(frames, own_s.tolist(), strict=True)
    ]
    found, _ = followed(clocked)
    assert absolute_error(found.world_from_scan, true_at(begins_s + late_s)).max_m < 0.05  # not 0.5
    velocity = found.velocity[12]
    read, of_sensor = deskewed_frame(clocked[12], velocity).read_points, frames[12].read_points
    assert read is not None and of_sensor is not None
    assert read().points_in_cam == pytest.approx(deskewed(of_sensor(), velocity, late_s).points_in_cam, abs=1e-3)


def test_every_third_sweep_is_deskewed_by_its_own_speed() -> None:
    found, _ = followed(street()[::3])
    rows = np.arange(0, COUNT, 3)
    assert absolute_error(found.world_from_scan, true_poses(rows)).max_m < NEAR_M
    assert np.linalg.norm(found.velocity[:, 3:], axis=1) == pytest.approx(SPEED_M_S, abs=0.5)


def test_a_repeated_sweep_gets_the_pose_of_its_copy_and_stops_nothing() -> None:
    frames = street().copy()
    frames[12:15] = [replace(frame, read_points=frames[11].read_points) for frame in frames[12:15]]
    found, said = followed(frames)
    assert found.found.all() and said.count("holds the same points as the sweep before it") == 3
    assert np.array_equal(found.world_from_scan[12:15], np.repeat(found.world_from_scan[11:12], 3, axis=0))
    rows = np.array([row for row in range(COUNT) if not 12 <= row < 15])
    assert absolute_error(found.world_from_scan[rows], true_poses(rows)).max_m < NEAR_M


def test_after_a_minute_without_sweeps_a_scanner_may_have_stopped() -> None:
    frames = [
        changed(replace(frame, stamp_s=UNIX_S + row * REVOLUTION_S), without_order)
        for row, frame in enumerate(street()[14::-1])  # backwards, so that it ends where the scanner stands
    ]
    standing = SpinningScanner(Road(1e-9), 0, beams=16, columns=360, noise=1.0).sweep(0)
    frames.append(Frame("later", UNIX_S + 60, read_points=lambda: without_order(PointCloud(standing.points))))
    found, said = followed(frames)
    assert "the recording stops for 58.6 s before later" in said
    moved = found.world_from_scan[-1, :3, 3] - found.world_from_scan[-2, :3, 3]
    assert np.linalg.norm(moved) < 2 * NEAR_M


def test_a_sweep_in_millimetres_among_others_is_left_out_and_named() -> None:
    frames = street().copy()
    frames[12] = changed(frames[12], lambda cloud: replace(cloud, points_in_cam=cloud.points_in_cam * 1000))
    found, said = followed(frames, max_range_m=40 * FARTHEST_M)  # a few of its points are in range then
    assert (~found.found).nonzero()[0].tolist() == [12]
    assert "12.pcd" in said and "millimetres" in said and "1 sweep is left out" in said


def test_a_scanner_whose_sweeps_cannot_be_read_leaves_the_other_be() -> None:
    frames = [*street()[:10], *(changed(frame, broken) for frame in street()[:10])]
    found, said = followed(frames, (np.arange(10), np.arange(10, 20)))
    assert found.found.tolist() == [True] * 10 + [False] * 10 and "5 more frames: the sweep is left out" in said
    with pytest.raises(SourceError, match="none of the 10 sweeps gave points in range; the first: frame 0.pcd"):
        followed(frames[10:])


def test_names_of_times_are_seconds_in_their_order(tmp_path: Path) -> None:
    nanoseconds = [1583836591_900000000, 1583836592_000000000, 1583836592_100000000, 1583836593_000000000]
    layouts: dict[str, Callable[[int], str]] = {
        "bag_to_pcd": lambda ns: f"{ns // 10**9}.{ns % 10**9:09d}",
        "two numbers": lambda ns: f"cloud_{ns // 10**9}_{ns % 10**9}",
        "nanoseconds": str,
        "microseconds": lambda ns: f"lidar-{ns // 1000}",
    }
    for layout, name in layouts.items():
        folder = tmp_path / layout
        folder.mkdir()
        for row, moment in enumerate(nanoseconds):
            write_ply(folder / f"{name(moment)}.ply", PointCloud(np.full((1, 3), row, np.float32)))
        frames = CloudFolderReader().open(folder).frames
        assert {frame.sequence for frame in frames} == {""}
        assert [frame.stamp_s for frame in frames] == pytest.approx([ns / 1e9 for ns in nanoseconds], abs=1e-6)
        points = [frame.read_points().points_in_cam[0, 0] for frame in frames if frame.read_points]
        assert points == [0, 1, 2, 3]


def test_sweeps_are_told_from_stations_and_fragments() -> None:
    timed = street()
    plain = [changed(frame, lambda cloud: replace(cloud, times_s=None)) for frame in timed]
    half = [changed(f, lambda c: PointCloud(c.points_in_cam[c.points_in_cam[:, 0] > 0])) for f in timed]
    narrow, wide = ([changed(f, partial(looking_ahead, half_deg=degrees)) for f in plain] for degrees in (30, 50))
    scans = half, plain[:5], narrow, wide
    for frames, recipe in [(timed, "lidar"), (plain, "lidar"), *((each, "scans") for each in scans)]:
        facts = {"frames": len(frames), "formats": [{"reader": "clouds"}], **frame_facts(frames, [])}
        assert next_command(Path("in"), facts, None) == f"hodge run {recipe} --source in --out runs/in"


def looking_ahead(cloud: PointCloud, half_deg: float) -> PointCloud:
    """The points as a depth camera of this field sees them, z ahead: on all sides of its axis, all over its image."""
    points = cloud.points_in_cam
    share = np.sqrt(np.random.default_rng(0).uniform(size=(len(points), 1)))
    ahead = np.linalg.norm(points, axis=1)[:, None] / np.tan(np.deg2rad(half_deg)) * [0, 0, 1]
    return PointCloud((share * points * [1, 1, 0] + ahead).astype(np.float32))


def mirrored(cloud: PointCloud) -> PointCloud:
    return replace(cloud, points_in_cam=cloud.points_in_cam * np.array([-1, 1, 1], np.float32))


@pytest.mark.parametrize("row", [0, 2, 12, COUNT - 1], ids=["the first", "the third", "in the middle", "the last"])
def test_a_sweep_that_fits_nothing_around_it_is_left_out_and_named(row: int) -> None:
    frames = street().copy()
    frames[row] = changed(frames[row], mirrored)
    found, said = followed(frames)
    assert (~found.found).nonzero()[0].tolist() == [row]
    assert f"1 sweep is left out, and posed by neighbours where these are known; the first: {row}.pcd: it fits" in said
    rows = np.flatnonzero(found.found)
    assert absolute_error(found.world_from_scan[rows], true_poses(rows)).max_m < NEAR_M


def test_the_first_two_sweeps_are_left_out_where_they_are_of_another_place() -> None:
    frames = [*(changed(frame, mirrored) for frame in street()[:2]), *street()[2:]]
    found, said = followed(frames)
    assert (~found.found).nonzero()[0].tolist() == [0, 1]
    assert "2 sweeps are left out" in said and "the first: 0.pcd: it fits none" in said
    rows = np.flatnonzero(found.found)
    assert absolute_error(found.world_from_scan[rows], true_poses(rows)).max_m < NEAR_M


def test_key_frames_begin_and_end_with_sweeps_that_were_found() -> None:
    poses = np.tile(np.eye(4), (12, 1, 1))
    poses[:, 0, 3] = 0.4 * np.arange(12)
    at_hand = np.arange(12) % 7 > 0  # without the first and the seventh
    at_hand[9:] = False
    found = Sweeps(poses, np.zeros((12, 6)), at_hand, np.zeros(12), np.ones(12, np.int64), 40.0)
    assert key_rows(found, (np.arange(9), np.arange(9, 12)), 1.0, 15.0).tolist() == [1, 4, 8]


def test_key_frames_have_the_points_of_the_sweeps_beside_them() -> None:
    quarter = se3.exp(np.array([0, 0, np.pi / 2, 0, 0, 0]))
    steps_m = np.array([0, 1, 1, 1, 3, 1, 1.0])  # sweep 2 was not found, sweep 4 is far from the one before
    poses = quarter @ se3.from_parts(np.eye(3), np.cumsum(steps_m)[:, None] * [1, 0, 0])
    post, reads = np.array([9.0, 5, 1]), list[int]()

    def seen(number: int, pose: Floats) -> PointCloud:
        reads.append(number)
        post_in_scan = se3.transform(se3.inverse(pose), post[None])
        return PointCloud(np.concatenate([post_in_scan, np.zeros((1, 3)), [[0.5, 0, 0]]]).astype(np.float32))

    source = Source("", Path(), tuple(Frame(n, n, read_points=partial(seen, n, pose)) for n, pose in enumerate(poses)))
    found = Sweeps(poses, np.zeros((7, 6)), np.arange(7) != 2, np.zeros(7), np.ones(7, np.int64), 25.0)
    sequences = np.arange(6), np.arange(6, 7)
    thick = thickened(source, np.array([0, 3, 5, 6]), found, sequences, CloudOptions(min_range_m=1.0, max_range_m=80.0))
    assert [frame.frame_id for frame in thick.frames] == [0, 3, 5, 6]
    for frame, posts in zip(thick.frames, (2, 2, 2, 1), strict=True):
        assert frame.read_points is not None
        cloud = frame.read_points()
        points, lent = cloud.points_in_cam, posts - 1
        assert cloud.no_numbers == lent, "the neighbours' points without a return"
        assert points.dtype == np.float32 and len(points) == posts + 2  # no return, and what is too near, its own alone
        pose = poses[int(frame.frame_id)]
        assert se3.transform(pose, points)[[0, *range(3, len(points))]] == pytest.approx(np.tile(post, (posts, 1)))
    assert sorted(reads) == [0, 1, 3, 4, 5, 6], "each once: sweep 1 is lent to two"


def test_a_scene_that_changes_is_followed() -> None:
    frames = [*street()[:12], *(changed(frame, mirrored) for frame in street()[12:])]
    found, said = followed(frames)
    assert found.found.all() and "left out" not in said


def test_a_sweep_without_points_in_the_middle_hides_no_scanner_and_is_named() -> None:
    for spoil, said in ((broken, "12.pcd cannot be read: cut off"), (nothing_of, "12.pcd has no points")):
        frames, oddities = street().copy(), list[str]()
        frames[COUNT // 2] = changed(frames[COUNT // 2], spoil)
        assert "its points have times" in str(frame_facts(frames, oddities)["scanner"])
        assert sum(said in oddity for oddity in oddities) == 1


def nothing_of(cloud: PointCloud) -> PointCloud:
    return PointCloud(cloud.points_in_cam[:0])


def test_sweeps_in_map_coordinates_are_said() -> None:
    poses = true_poses(range(COUNT))
    poses = se3.inverse(poses[0]) @ poses

    def moved(pose: Floats, cloud: PointCloud) -> PointCloud:
        return PointCloud(se3.transform(pose, cloud.points_in_cam.astype(float)).astype(np.float32))

    frames = [changed(frame, partial(moved, pose)) for frame, pose in zip(street(), poses, strict=True)]
    assert "seem to be in map coordinates: the middle of their points moves by 1" in followed(frames)[1]
    assert "map coordinates" not in street_followed()[1]
