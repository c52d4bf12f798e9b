"""Spinning scanners: times of points, deskewing, the street that is modelled, scans out of doors in no order."""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import cast

import numpy as np
import pytest

from hodge_adapters.clouds.columns import points_of_columns, seconds_after_first
from hodge_adapters.clouds.fragments import Fragment, read_fragment
from hodge_adapters.clouds.ply import write_ply
from hodge_adapters.clouds.reader import CloudFolderReader
from hodge_pipeline import se3
from hodge_pipeline.demo.sequence import make_sequence
from hodge_pipeline.demo.street import HOUSES_M, Road, build_street
from hodge_pipeline.demo.sweeps import FARTHEST_M, REVOLUTION_S, TRUTH_FILE, SpinningScanner, StreetOptions, Sweep
from hodge_pipeline.errors import SourceError
from hodge_pipeline.evaluation.trajectory import absolute_error
from hodge_pipeline.recipe.scale import measured_scale
from hodge_pipeline.recipe.schema import load_recipe
from hodge_pipeline.registration.clouds import CloudOptions, make_cloud
from hodge_pipeline.registration.sweeps import deskewed, velocities
from hodge_pipeline.stages import Step, no_progress
from hodge_pipeline.start.sweeps import follow
from hodge_pipeline.types import Floats, Frame, Ints, PointCloud, Source
from hodge_pipeline.uses.recipe_run import run
from hodge_pipeline.uses.trajectory import refine_trajectory
from lidar_worlds import CarFree
from mcap_data import SECOND, Log, point_cloud, ros_header
from mcap_encoding import CDR

UNIX_S = 1_700_000_000.0


def test_a_revolution_tells_the_unit_of_its_times() -> None:
    seconds, every = np.linspace(0, 0.1, 50), np.ones(50, bool)
    for unit, first in ((1.0, 0.0), (1e-3, 7.0), (1e-6, 1e6), (1e-9, 1.7e18)):
        found, first_s = seconds_after_first(first + seconds / unit, every)
        assert found is not None and found == pytest.approx(seconds, abs=1e-6 if unit > 1e-9 else 3e-7)
        assert first_s == pytest.approx(first * unit)
    assert seconds_after_first(np.zeros(50), every)[0] is None  # an organised cloud without a clock
    assert seconds_after_first(np.where(seconds > 0, seconds, np.nan), every)[0] is None
    of_float32 = (UNIX_S + seconds).astype(np.float32) + np.where(seconds > 0.05, np.float32(128), 0)
    assert seconds_after_first(of_float32.astype(float), every)[0] is None  # no tenth of a second in milliseconds


def test_points_without_a_return_tell_no_unit_of_times() -> None:
    returned = np.arange(50) % 7 > 0
    times = np.where(returned, UNIX_S + np.linspace(0, 0.1, 50), 0.0)
    found, first_s = seconds_after_first(times, returned)
    assert found is not None and found.max() == pytest.approx(0.1, abs=5e-3) and not found[~returned].any()
    assert first_s == pytest.approx(UNIX_S, abs=0.01)


def test_times_come_with_the_points_of_a_pcd(tmp_path: Path) -> None:
    points = np.array([[1, 2, 3, 0.0], [np.nan, 0, 0, 0.05], [4, 5, 6, 0.08], [4, 5, 6, 0.1]], "<f4")
    header = (
        "VERSION 0.7\nFIELDS x y z time\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\nWIDTH 4\nHEIGHT 1\nPOINTS 4\n"
        "DATA binary\n"
    )
    (tmp_path / "0.pcd").write_bytes(header.encode() + points.tobytes())
    cloud = read_fragment(Fragment(tmp_path / "0.pcd"))
    assert cloud.times_s == pytest.approx([0.0, 0.08, 0.1]) and len(cloud) == 3
    read = CloudFolderReader(units_per_metre=1000).open(tmp_path).frames[0].read_points
    assert read is not None and read().times_s == pytest.approx([0.0, 0.08, 0.1])  # in millimetres too
    assert read().points_in_cam[1] == pytest.approx([0.004, 0.005, 0.006])


@pytest.mark.parametrize(
    ("name", "unit_s"),
    [("time_offset", 1e-9), ("relative_time", 1e-3), ("GpsTime", 1.0), ("ts", 1e-6), ("t_us", 1e-6), ("Stamp", 1.0)],
)
def test_times_of_points_have_many_names(name: str, unit_s: float) -> None:
    seconds, points = np.array([0, 0.05, 0.1]), dict.fromkeys("xyz", np.ones(3))
    cloud = points_of_columns(Path(), points | {"t": np.zeros(3), name: seconds / unit_s})
    assert cloud.times_s == pytest.approx(seconds)  # the column `t` tells nothing


@pytest.mark.parametrize(("name", "unit_s"), [("gps_time", 1e-3), ("t_us", 1e-9), ("T", 1.0), ("intensity", 1.0)])
def test_what_is_in_other_units_than_its_name_says_is_no_time(name: str, unit_s: float) -> None:
    columns = dict.fromkeys("xyz", np.ones(3)) | {name: np.array([0, 0.05, 0.1]) / unit_s}
    assert points_of_columns(Path(), columns).times_s is None


def scanner(noise: float = 0.0) -> SpinningScanner:
    return SpinningScanner(Road(10.0), 0, beams=12, columns=360, noise=noise)


def cloud_of(sweep: Sweep) -> PointCloud:
    return PointCloud(sweep.points, times_s=sweep.times_s)


def test_a_deskewed_sweep_is_what_a_scanner_at_rest_would_see() -> None:
    sweep = scanner().sweep(20)
    at = scanner().road.world_from_car(2.0 + np.array([0.0, REVOLUTION_S]))
    velocity = velocities(at, np.array([0.0, REVOLUTION_S]))[0]
    exact = scanner().road.world_from_car(2.0 + sweep.times_s.astype(float))
    world = np.einsum("nij,nj->ni", exact[:, :3, :3], sweep.points) + exact[:, :3, 3]
    still = se3.transform(se3.inverse(at[0]), world)
    before = np.linalg.norm(sweep.points - still, axis=1)
    after = np.linalg.norm(deskewed(cloud_of(sweep), velocity).points_in_cam - still, axis=1)
    assert before.max() > 0.9 and after.max() < 0.03


def test_no_returns_of_a_sweep_are_none_after_it_is_deskewed() -> None:
    """Drivers write them as zeros: moved along they would stand as a row of points on the scanner's way."""
    rng = np.random.default_rng(0)
    points = rng.uniform(5, 9, (100, 3)).astype(np.float32)
    points[::2] = 0
    cloud = PointCloud(points, times_s=np.linspace(0, 0.1, 100).astype(np.float32))
    moved = deskewed(cloud, np.array([0.0, 0, 0, 10, 0, 0]))
    assert np.array_equal(moved.points_in_cam.any(axis=1), points.any(axis=1))
    _, counts = make_cloud(Frame(0, 0.0, read_points=lambda: moved), CloudOptions(min_range_m=0, max_range_m=90))
    assert (counts.valid, counts.no_returns) == (50, 50)


def test_without_times_nothing_is_deskewed() -> None:
    cloud = PointCloud(np.ones((3, 3), np.float32))
    assert deskewed(cloud, np.ones(6)) is cloud


def test_the_road_is_closed_smooth_and_clear() -> None:
    road = Road(10.0)
    poses = road.world_from_car(np.arange(0, road.length_m / 10.0, 0.05))
    steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    assert 480 < road.length_m < 520 and steps == pytest.approx(0.5, abs=0.05)
    first, last = road.world_from_car(np.array([0.0, road.length_m / 10.0]))
    assert np.linalg.norm(first[:2, 3] - last[:2, 3]) < 0.1
    vertices, _ = build_street(0)
    low = vertices[(vertices[:, 2] > 0.05) & (vertices[:, 2] < 3.0)]
    gaps = np.linalg.norm(low[:, None, :2] - poses[None, ::10, :2, 3], axis=2).min()
    assert gaps > 0.3 * HOUSES_M / 2


def test_north_and_south_are_alike() -> None:
    road = Road(10.0)
    half = road.length_m / 2 / 10.0
    here, there = road.world_from_car(np.array([3.0, 3.0 + half]))
    assert np.linalg.norm(here[:2, 3] + there[:2, 3]) < 0.2
    vertices, _ = build_street(0)
    middle = vertices[(np.abs(vertices[:, 0]) < 50) & (np.abs(np.abs(vertices[:, 1]) - 52) < 12)]
    turned = middle * np.array([-1, -1, 1])
    far = [np.linalg.norm(middle - corner, axis=1).min() for corner in turned[:200]]
    assert max(far) < 1e-6


def test_a_sweep_is_the_same_every_time_and_in_range() -> None:
    first, again = scanner(1.0).sweep(7), scanner(1.0).sweep(7)
    assert np.array_equal(first.points, again.points)
    ranges = np.linalg.norm(first.points, axis=1)
    assert ranges.max() < FARTHEST_M + 0.5 and first.times_s.min() >= 0 and first.times_s.max() < REVOLUTION_S


def test_a_scan_of_few_beams_wants_several_points_a_voxel() -> None:
    sweep = cloud_of(scanner().sweep(3))
    assert measured_scale([Frame(0, 0.0, read_points=lambda: sweep)], 0.04) > 5


@pytest.fixture
def kitti(data_dir: Path) -> tuple[list[Floats], list[Floats]]:
    """Points (N, 3) and poses of five scans over 28 m of road."""
    folder = data_dir / "scans" / "kitti_07_5scans"
    points = [read().points_in_cam for frame in CloudFolderReader().open(folder).frames if (read := frame.read_points)]
    rows = [line.split() for line in (folder / "graph.txt").read_text().splitlines() if line.startswith("v")]
    values = np.array([row[1:8] for row in rows], float)
    return points, list(se3.from_quat_xyzw(values[:, :3], values[:, 3:]))


def test_five_scans_of_a_street_out_of_order(kitti: tuple[list[Floats], list[Floats]], tmp_path: Path) -> None:
    points, poses = kitti
    order = 4, 1, 3, 0, 2
    frames = tuple(
        Frame(name, float(name), read_points=partial(PointCloud, points[row])) for name, row in enumerate(order)
    )
    recipe = load_recipe("scans", OFF)
    found = run(recipe, tmp_path / "run", source=Source("street", tmp_path, frames)).poses
    for a in range(5):
        for b in range(a):
            truth = se3.inverse(poses[order[a]]) @ poses[order[b]]
            error = se3.inverse(se3.inverse(found[a]) @ found[b]) @ truth
            assert np.linalg.norm(error[:3, 3]) < 0.055
            assert np.degrees(np.linalg.norm(se3.so3_log(error[:3, :3]))) < 0.6


def test_a_street_is_followed_and_deskewed(tmp_path: Path) -> None:
    options = StreetOptions(frames=25, beams=16, columns=360)
    folder = make_sequence(tmp_path / "street", options)
    exact = Road(options.speed_m_s).world_from_car(np.arange(25) * REVOLUTION_S)
    known = se3.exp(np.array([0, 0, 2.0, 300, -200, 40])) @ exact @ se3.from_parts(np.eye(3), np.array([0.5, 0, 1.0]))
    known[9, 0, 3] += 50
    rows = [f"{name:06d},{x:.3f},{y:.3f},{z:.3f},0.1" for name, (x, y, z) in enumerate(known[:, :3, 3])]
    (tmp_path / "fixes.csv").write_text("\n".join(["name,e,n,u,sigma", *rows]))
    changes = {
        "evaluation.truth": str(folder / TRUTH_FILE), "recording.level": "off", "fusion": [], "executor.workers": 0,
        "positions.path": str(tmp_path / "fixes.csv"), "positions.antenna_m": [0.5, 0, 1.0],
    }  # fmt: skip
    recipe = load_recipe("lidar", [f"{key}={json.dumps(value)}" for key, value in changes.items()], folder)
    done = run(recipe, tmp_path / "run")
    antenna = se3.transform(done.poses, np.tile([[[0.5, 0, 1.0]]], (25, 1, 1)))[:, 0]
    right = np.arange(25) != 9
    assert np.linalg.norm(antenna - known[:, :3, 3], axis=1)[right].max() < 0.5
    report = json.loads((tmp_path / "run" / "report.json").read_text())
    assert [name.startswith("000009") for name in report["positions"]["rejected"]] == [True]
    assert "rejected" in (tmp_path / "run" / "positions.csv").read_text()
    moved = se3.inverse(done.poses[0]) @ done.poses[-1]
    error = se3.inverse(moved) @ se3.inverse(exact[0]) @ exact[-1]
    assert 16 < np.linalg.norm(moved[:3, 3]) < 18 and np.linalg.norm(error[:3, 3]) < 0.3
    every = se3.inverse(done.poses[0]) @ done.poses, se3.inverse(exact[0]) @ exact
    assert np.linalg.norm((every[0] - every[1])[:, :3, 3], axis=1).max() < 0.5  # the first sweeps too: no start at rest
    assert len(done.key_frames.rows) < 20
    keys, edges = done.key_frames, done.rounds[1].edges
    steps = np.flatnonzero(np.diff(edges.pairs, axis=1)[:, 0] == 1)
    by_map = se3.inverse(keys.world_from_key[:-1]) @ keys.world_from_key[1:]
    assert edges.i_from_j[steps] == pytest.approx(by_map, abs=1e-9)  # not as registration of two clouds has them
    assert done.source.frames[0].true_world_from_cam is not None


@dataclass(frozen=True)
class Flight(CarFree):
    """A scanner that climbs, rolls and swings its yaw by up to 60 degrees a second while it flies down the street."""

    speed_m_s: float
    length_m: float = 1e9

    def world_from_car(self, times_s: Floats) -> Floats:
        """Poses (N, 4, 4)."""
        t = np.asarray(times_s, float)
        position = np.stack([-60 + self.speed_m_s * t, -52 + np.sin(t), 3 - np.cos(t)], axis=1)
        turn = np.stack([0.3 * np.sin(1.3 * t), 0.2 * np.sin(0.9 * t + 1), 0.5 * np.sin(2 * t)], axis=1)
        return se3.from_parts(se3.so3_exp(turn), position)


@pytest.mark.parametrize("path", [Flight(4.0), Road(25.0)], ids=["flown", "fast"])
def test_sweeps_are_followed_from_the_first_at_any_speed(path: Flight | Road, tmp_path: Path) -> None:
    count = 15
    own = SpinningScanner(cast(Road, path), 0, beams=16, columns=360, noise=1.0)
    for number in range(count):
        write_organised(tmp_path / f"{number}.pcd", own.sweep(number), 16 * 360, np.nan)
    source = CloudFolderReader().open(tmp_path)
    every, clouds = np.arange(count), CloudOptions(max_range_m=FARTHEST_M)
    step = Step(tmp_path, no_progress, lambda *notes: None)
    found = follow(source, (every,), clouds, None, step=step)
    assert absolute_error(found.world_from_scan, path.world_from_car(every * REVOLUTION_S)).max_m < 0.25


def test_a_point_at_the_scanner_itself_is_no_measurement() -> None:
    points = np.array([[0, 0, 0], [5, 0, 0], [0, 0, 0], [0, 5, 0], [0, 0, 5]], np.float32)
    cloud, _ = make_cloud(Frame(0, 0.0, read_points=lambda: PointCloud(points)), CloudOptions(min_range_m=0))
    assert len(cloud) == 3 and np.linalg.norm(cloud.points_in_cam, axis=1).min() > 1


def test_a_robot_that_stands_still_has_few_key_frames_and_stays(tmp_path: Path) -> None:
    folder = make_sequence(tmp_path / "street", StreetOptions(frames=8, beams=16, columns=360, speed_m_s=1e-6))
    done = run(load_recipe("lidar", SHORT, folder), tmp_path / "run")
    assert len(done.key_frames.rows) <= 2 and np.linalg.norm(done.poses[:, :3, 3], axis=1).max() < 0.5


def write_organised(path: Path, sweep: Sweep, rows: int, missing: float) -> None:
    """A PCD of 16 rows: every return that the sweep lacks is a point `missing` on all axes, without a time."""
    points = np.full((rows, 4), missing, "<f4")
    seen = np.sort(np.random.default_rng(0).choice(rows, len(sweep.points), replace=False))
    points[seen] = np.column_stack([sweep.points, sweep.times_s])
    header = (
        "VERSION 0.7\nFIELDS x y z t\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\n"
        f"WIDTH {rows // 16}\nHEIGHT 16\nPOINTS {rows}\nDATA binary\n"
    )
    path.write_bytes(header.encode() + points.tobytes())


OFF = ["recording.level=off", "evaluation.tables=false", "executor.workers=0"]
SHORT = [*OFF, "fusion=[]"]


def test_organised_clouds_with_holes_are_followed_and_none_that_no_poses_pair_is_described(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, road, described = tmp_path / "sweeps", Road(10.0), list[int]()

    def describe(clouds: Path, registrar: object, rows: Ints, *_: object) -> None:
        described.extend(rows.tolist())

    monkeypatch.setattr("hodge_pipeline.start.unordered.start.describe_clouds", describe)
    folder.mkdir()
    own = SpinningScanner(road, 0, beams=16, columns=360, noise=1.0)
    for number in range(14):
        write_organised(folder / f"{number}.pcd", own.sweep(number), 16 * 360, np.nan if number % 2 else 0.0)
    done = run(load_recipe("lidar", SHORT, folder), tmp_path / "run")
    exact = road.world_from_car(np.arange(14) * REVOLUTION_S)
    assert absolute_error(done.poses, exact).max_m < 0.08  # 0.05 m; 0.10 m where no sweep is deskewed
    assert not described  # a straight road of 14 m has no loop


def test_two_scanners_in_a_folder_are_followed_apart(tmp_path: Path) -> None:
    folder, road = tmp_path / "sweeps", Road(10.0)
    folder.mkdir()
    car_from_front = se3.exp(np.array([0, 0, np.pi / 2, 1.0, 0.5, -0.8]))
    top, front = (SpinningScanner(road, 0, beams, columns=240, noise=1.0) for beams in (16, 12))
    for number in range(8):
        write_organised(folder / f"top_{number}.pcd", top.sweep(number), 16 * 240, np.nan)
        points = se3.transform(se3.inverse(car_from_front), front.sweep(number).points.astype(float))
        write_ply(folder / f"{number}_front.ply", PointCloud(points.astype(np.float32)))
    done = run(load_recipe("lidar", SHORT, folder), tmp_path / "run")
    assert "(*_front.ply 8, top_*.pcd 8): each is a sequence" in " ".join(done.source.notes)
    exact = road.world_from_car(np.arange(8) * REVOLUTION_S)
    names = np.array([frame.sequence for frame in done.source.frames])
    for name, true in (("top_*.pcd", exact), ("*_front.ply", exact @ car_from_front)):
        assert absolute_error(done.poses[names == name], true).max_m < 0.5


def test_files_of_times_beside_scans_are_left_out_and_told(tmp_path: Path) -> None:
    own = SpinningScanner(Road(10.0), 0, beams=16, columns=60, noise=1.0)
    for number in range(2):
        sweep = own.sweep(number)
        whole = 3 * (len(sweep.points) // 3)  # so that the times could be rows of three columns
        sweep.points[:whole].tofile(tmp_path / f"raw_{number:02d}.bin")
        np.sort(sweep.times_s)[:whole].astype("<f4").tofile(tmp_path / f"times_{number:02d}.bin")
    source = CloudFolderReader().open(tmp_path)
    assert [frame.frame_id for frame in source.frames] == ["raw_00.bin", "raw_01.bin"]
    assert "2 .bin files hold numbers that ascend, such as times, no points: left out: times_00.bin" in source.notes[0]
    for scan in tmp_path.glob("raw_*"):
        scan.unlink()
    with pytest.raises(SourceError, match="2 .bin files hold numbers that ascend"):
        CloudFolderReader().open(tmp_path)


def sweeps_as(layout: str, folder: Path, count: int, speed_m_s: float = 10.0) -> Path:
    """Sweeps of the street as a folder in KITTI's layout, or as a recording."""
    log, own = Log(), SpinningScanner(Road(speed_m_s), 0, beams=16, columns=360, noise=1.0)
    (folder / "velodyne").mkdir()
    for number in range(count):
        points = own.sweep(number).points
        np.column_stack([points, np.full(len(points), 0.3)]).astype("<f4").tofile(
            folder / "velodyne" / f"{number:06d}.bin"
        )
        columns = {axis: points[:, row] for row, axis in enumerate("xyz")}
        message = {"header": ros_header(float(number), "lidar"), **point_cloud(columns, {"x": 0, "y": 4, "z": 8}, 16)}
        log.add("/points", "sensor_msgs/msg/PointCloud2", message, CDR, number * SECOND + 1)
    return folder / "velodyne" if layout == "kitti" else log.write(folder / "log.mcap")


def test_a_trajectory_of_sweeps_is_refined_by_default(tmp_path: Path) -> None:
    count = 16
    exact = Road(10.0).world_from_car(np.arange(count) * REVOLUTION_S)
    noise = np.random.default_rng(0).normal(0, [1e-3] * 3 + [0.06] * 3, (count, 6))
    given = exact @ se3.exp(np.cumsum(noise, axis=0))
    frames = sweeps_as("recording", tmp_path, count)
    refined = refine_trajectory(given, frames, overrides=OFF)
    before, after = (absolute_error(poses, exact).rmse_m for poses in (given, refined.poses))
    assert before > 0.1 and after < before / 2


@pytest.mark.parametrize("kind", ["right", "jump", "axes of a camera"])
def test_poses_of_sweeps_are_never_worse_than_they_came(kind: str, tmp_path: Path) -> None:
    exact = Road(7.0).world_from_car(np.arange(16) * REVOLUTION_S)
    given = exact.copy()
    if kind == "jump":
        given[8:, :3, 3] += [0.6, 0.8, 0.0]
    if kind == "axes of a camera":  # x right, y down, z ahead
        given = exact @ se3.from_parts(np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]), np.zeros(3))
    refined = refine_trajectory(given, sweeps_as("kitti", tmp_path, 16, 7.0), overrides=OFF)
    assert absolute_error(refined.poses, exact).max_m < 0.05
