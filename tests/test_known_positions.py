"""Positions known from elsewhere: tables, fixes of recordings, and poses solved with them."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from hodge_adapters.mcap.reader import McapReader
from hodge_adapters.trajectories.positions import PositionsReader
from hodge_pipeline import se3
from hodge_pipeline.complex.components import connected_components
from hodge_pipeline.errors import SourceError
from hodge_pipeline.report import known_positions as shown
from hodge_pipeline.rounds.one_round import Work
from hodge_pipeline.solvers.positions import Fixes, align_positions, place
from hodge_pipeline.sources.inspect import guess_reader
from hodge_pipeline.testing import check_reader
from hodge_pipeline.types import CloudSet, Floats, PointCloud, ViewGraph
from hodge_pipeline.types.positions import earth_centred
from mcap_data import Log
from mcap_encoding import JSON

SIGMA_M = 0.5
UP = np.array([0.0, 0.0, 1.0])


def table(folder: Path, text: str) -> Path:
    path = folder / "fixes.csv"
    path.write_text(text)
    return path


def test_a_table_of_metres_with_sigma(tmp_path: Path) -> None:
    path = table(
        tmp_path, "\ufeffImage; East [m]; North; Up; sigma\n\na.jpg; 1; 2; 3; 0.1\nb.jpg; 4; 5; 6;\nc.jpg; ; ;\n"
    )
    source = check_reader(PositionsReader(), path)
    found = source.positions
    assert found is not None and found.names.tolist() == ["a.jpg", "b.jpg"]
    assert found.points.tolist() == [[1, 2, 3], [4, 5, 6]]
    assert found.covariances[0] == pytest.approx(0.01 * np.eye(3)) and np.isnan(found.covariances[1]).all()
    assert "1 row without" in source.notes[0] and "line 5" in source.notes[0]
    assert isinstance(guess_reader(path), PositionsReader)


def test_positions_by_seconds_since_1970_are_told_apart(tmp_path: Path) -> None:
    path = table(tmp_path, "stamp,e,n,u\n1700000000.2,1,2,3\n1700000000.5,4,5,6\n")
    found = PositionsReader().open(path).positions
    assert found is not None and found.labels.tolist() == ["1700000000.200 s", "1700000000.500 s"]


def test_a_table_of_degrees_is_east_north_up_of_its_first_row(tmp_path: Path) -> None:
    path = table(
        tmp_path, "timestamp,latitude,longitude,altitude\n10.5,49,8,100\n11.5,49.001,8,103\n12.5,49,8.001,100\n"
    )
    found = PositionsReader().open(path).positions
    assert found is not None and found.stamps_s.tolist() == [10.5, 11.5, 12.5] and found.names.tolist() == ["", "", ""]
    # Radii of the meridian and of the parallel at 49° on WGS 84: 6371.9 km and 4192.4 km.
    assert found.points[1] == pytest.approx([0, 6371.9e3 * np.radians(0.001), 3], abs=0.01)
    assert found.points[2] == pytest.approx([4192.5e3 * np.radians(0.001), 0, 0], abs=0.01)
    assert "latitude 49.0" in found.origin
    assert earth_centred(np.array([[0.0, 90.0, 2.0]])) == pytest.approx(np.array([[0, 6378139.0, 0]]), abs=1e-6)


def test_coordinates_of_a_map_lose_whole_kilometres(tmp_path: Path) -> None:
    path = table(tmp_path, "name e n u\n1 456789.5 5428123.25 120\n2 456790.5 5428124 121\n")
    found = PositionsReader().open(path).positions
    assert found is not None and found.points[0] == pytest.approx([-210.5, 123.25, 120])
    assert found.origin.startswith("(457000, 5428000, 0)")


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("name,e,n\n1,2,3\n", ":1: the first line names no columns"),
        ("e,n,u\n1,2,3\n", ":1: the first line names no columns"),
        ("", ":1: the first line names no columns"),
        ("name,e,n,u\n1,2,3,4\n2,x,3,4\n", ":3: e is 'x': expected a number"),
        ("name,e,n,u,sigma\n1,2,3,4,-1\n2,2,3,4,0\n", ":3: its sigma or covariance is not positive"),
        ("name,lat,lon,alt\n1,5428000,457000,0\n", "are no degrees"),
        ("name,e,n,u\n1,nan,2,3\n", "no row has"),
        ('name,e,n,u\n"a b",1,2,3\n"b,1,2,3\nc,1,2,3\n', ":3: cannot be cut into cells"),
    ],
)
def test_a_table_that_says_nothing_is_one_line(tmp_path: Path, text: str, why: str) -> None:
    with pytest.raises(SourceError, match="fixes.csv") as error:
        PositionsReader().open(table(tmp_path, text))
    assert why in str(error.value)


def test_of_rows_with_the_same_name_and_stamp_the_first_is_kept(tmp_path: Path) -> None:
    source = PositionsReader().open(table(tmp_path, "name,t,e,n,u\na,,1,2,3\na,,4,5,6\nb,1,7,8,9\nb,2,7,8,9\n"))
    assert source.positions is not None and source.positions.names.tolist() == ["a", "b", "b"]
    assert source.positions.points[0].tolist() == [1, 2, 3]
    assert source.notes == ("1 row with the name and stamp of an earlier one left out: line 3",)


def test_a_trajectory_with_a_head_is_no_table_of_positions(tmp_path: Path) -> None:
    path = table(tmp_path, "# timestamp x y z qx qy qz qw\n1 0 0 0 0 0 0 1\n2 1 0 0 0 0 0 1\n")
    assert PositionsReader().sniff(path).confidence == 0


def test_fixes_of_a_recording_come_with_their_covariance(tmp_path: Path) -> None:
    log = Log()
    for row, status in enumerate((0, -1, 2)):
        fix = {
            "timestamp": {"sec": 100 + row, "nsec": 0},
            "latitude": 49.0 + row * 1e-4,
            "longitude": 8.0,
            "altitude": 100.0,
            "status": {"status": status},
            "position_covariance": [4, 0, 0, 0, 4, 0, 0, 0, 9],
            "position_covariance_type": 0 if row else 2,
        }
        log.add_bytes("/fix", "foxglove.LocationFix", JSON, json.dumps(fix).encode(), row + 1)
    source = check_reader(McapReader(), log.write(tmp_path / "log.mcap"))
    found = source.positions
    assert found is not None and found.stamps_s.tolist() == [100, 102]
    assert found.points[1] == pytest.approx([0, 22.24, 0], abs=0.01)
    assert found.covariances[0] == pytest.approx(np.diag([4, 4, 9])) and np.isnan(found.covariances[1]).all()
    assert any("no satellite fix" in note for note in source.notes)


def drifting_loop(frames: int = 120, seed: int = 0) -> tuple[ViewGraph, Floats, Floats]:
    """A graph of edges one to four frames long around a loop, that is not closed, its odometry, and the true poses.

    A turn too far by 1.5e-3 rad a frame drifts by 5 m; its information states a fifteenth of the errors.
    """
    rng = np.random.default_rng(seed)
    way = np.linspace(0, 1.9 * np.pi, frames)
    turns = se3.so3_exp(np.stack([0 * way, 0 * way, way + np.pi / 2], axis=1))
    true = se3.from_parts(turns, np.stack([80 * np.cos(way), 50 * np.sin(way), np.sin(3 * way)], axis=1))
    edges = np.concatenate([np.stack([np.arange(frames - k), np.arange(k, frames)], axis=1) for k in (1, 2, 3, 4)])
    noise = np.concatenate([rng.normal(0, 1e-3, (len(edges), 3)), rng.normal(0, 0.03, (len(edges), 3))], axis=1)
    noise[:, 2] += 1.5e-3 * (edges[:, 1] - edges[:, 0])
    motions = se3.inverse(true[edges[:, 0]]) @ true[edges[:, 1]] @ se3.exp(noise)
    information = np.broadcast_to(np.diag([15e3**2] * 3 + [500.0**2] * 3), (len(edges), 6, 6))
    odometry = np.tile(np.eye(4), (frames, 1, 1))
    for row in range(frames - 1):
        odometry[row + 1] = odometry[row] @ motions[row]
    return ViewGraph.from_edges(np.arange(frames), edges, motions, information.copy()), odometry, true


def fixes_at(true: Floats, rows: np.ndarray, arm: tuple[float, float, float] = (0, 0, 0), seed: int = 0) -> Fixes:
    arms = np.broadcast_to(np.array(arm, float), (len(rows), 3)).copy()
    points = np.einsum("nij,nj->ni", true[rows, :3, :3], arms) + true[rows, :3, 3]
    points = points + np.random.default_rng([seed, 1]).normal(0, SIGMA_M, (len(rows), 3))
    covariances = np.broadcast_to(SIGMA_M**2 * np.eye(3), (len(rows), 3, 3)).copy()
    return Fixes(rows, arms, points, covariances, np.ones(len(rows), bool), rows.astype(str), "here")


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_drift_is_taken_out_and_a_jump_rejected_and_named(seed: int) -> None:
    graph, odometry, true = drifting_loop(seed=seed)
    fixes = fixes_at(true, np.arange(0, 120, 2), arm=(0.5, -0.3, 1.0), seed=seed)
    fixes.points[20:26] += [50, 0, 0]
    component = np.zeros(120, np.int64)
    found = place(graph, odometry, component, np.ones(graph.edge_count), fixes, UP)
    aligned, _ = align_positions(odometry[:, :3, 3], true[:, :3, 3], np.full(120, SIGMA_M), UP)
    drift_m = np.linalg.norm(se3.transform(aligned, odometry[:, :3, 3]) - true[:, :3, 3], axis=1)
    off_m = np.linalg.norm(found.world_from_cam[1::2, :3, 3] - true[1::2, :3, 3], axis=1)
    assert drift_m.max() > 3 and off_m.max() < 3 * SIGMA_M and np.sqrt((off_m**2).mean()) < SIGMA_M
    rejected = [note for note in shown.notes(found.fit) if note.kind == "positions rejected"]
    assert rejected[0].count == 6 and str(rejected[0]).endswith("40–50")
    assert found.fit.edge_factor > 5 and found.fit.fix_factor < 1.2


def errors(found: Floats, true: Floats) -> tuple[float, float]:
    """Root mean square of steps, metres, and the largest turn, degrees, against the true poses."""
    steps = [se3.inverse(poses[:-1]) @ poses[1:] for poses in (true, found)]
    off = se3.log(se3.inverse(steps[0]) @ steps[1])[:, 3:]
    turns = se3.rotation_angle(se3.inverse(true)[:, :3, :3] @ found[:, :3, :3])
    return float(np.sqrt((off**2).sum(axis=1).mean())), float(np.degrees(turns.max()))


@pytest.mark.parametrize("every", [1, 5])
def test_noise_of_positions_neither_shakes_steps_nor_turns_poses(every: int) -> None:
    """Lengths 1 % too large; where little is seen, edges are weak: noise went into these."""
    graph, _, true = drifting_loop(seed=4)
    motions = (se3.inverse(true[graph.edges[:, 0]]) @ true[graph.edges[:, 1]]).copy()
    motions[:, :3, 3] *= 1.01
    weak = (graph.edges.min(axis=1) % 12 < 3)[:, None, None]
    graph = replace(graph, i_from_j=motions, information=np.where(weak, graph.information / 400, graph.information))
    odometry = [true[0]]
    for row in range(119):
        odometry.append(odometry[-1] @ motions[row])
    fixes = fixes_at(true, np.arange(0, 120, every), seed=4)
    found = place(graph, np.stack(odometry), np.zeros(120, np.int64), np.ones(len(graph.edges)), fixes, UP)
    before_m, _ = errors(np.stack(odometry), true)
    after_m, turn_deg = errors(found.world_from_cam, true)
    assert after_m < before_m and turn_deg < 1.5 and found.fit.used.all()


def test_positions_that_scatter_more_than_they_state_are_told_and_tear_nothing() -> None:
    graph, odometry, true = drifting_loop()
    fixes = fixes_at(true, np.arange(120))
    fixes.covariances[:] /= 100
    found = place(graph, odometry, np.zeros(120, np.int64), np.ones(graph.edge_count), fixes, UP)
    off_m = np.linalg.norm(found.world_from_cam[:, :3, 3] - true[:, :3, 3], axis=1)
    assert found.fit.fix_factor == pytest.approx(10, rel=0.3) and np.sqrt((off_m**2).mean()) < SIGMA_M
    assert any(note.kind == "positions scatter" for note in shown.notes(found.fit))


def test_each_piece_finds_its_own_place_and_one_with_two_positions_none() -> None:
    graph, odometry, true = drifting_loop()
    split = graph.edges // 40
    graph = graph.select(split[:, 0] == split[:, 1])
    component = connected_components(graph.edges, 120)
    for number, piece in enumerate((0, 1, 2)):
        odometry[component == piece] = se3.exp(np.full(6, 0.3 * number)) @ odometry[component == piece]
    fixes = fixes_at(true, np.concatenate([np.arange(80), [90, 100]]))
    found = place(graph, odometry, component, np.ones(graph.edge_count), fixes, UP)
    off_m = np.linalg.norm(found.world_from_cam[:, :3, 3] - true[:, :3, 3], axis=1)
    assert (
        off_m[:80].max() < 4 * SIGMA_M
        and np.ptp(found.component[:80]) == 0
        and found.component[0] != found.component[90]
    )
    assert np.array_equal(found.world_from_cam[80:], odometry[80:])
    assert found.fit.problems == ("40 frames are not placed: 2 known positions among them, 3 are needed",)
    assert np.isnan(found.fit.distance[-2:]).all() and "not placed" in shown.as_csv(found.fit)


def test_a_robot_at_rest_has_no_heading_by_its_fixes() -> None:
    graph, odometry, true = drifting_loop()
    still = true.copy()
    still[:, :3, 3] = true[0, :3, 3]
    fixes = fixes_at(still, np.arange(120))
    found = place(graph, odometry, np.zeros(120, np.int64), np.ones(graph.edge_count), fixes, UP)
    assert "tells no heading" in found.fit.problems[0] and np.array_equal(found.world_from_cam, odometry)


@pytest.mark.parametrize(("heading", "exact"), [(3.1, False), (0.0, False), (0.0, True)])
def test_positions_on_a_line_leave_the_scanner_upright(heading: float, exact: bool) -> None:
    frames = 40
    true = se3.from_parts(np.tile(se3.so3_exp(np.array([0, 0, heading])), (frames, 1, 1)), np.zeros((frames, 3)))
    true[:, :3, 3] = np.arange(frames)[:, None] * 3.0 * true[0, :3, 0]
    edges = np.stack([np.arange(frames - 1), np.arange(1, frames)], axis=1)
    graph = ViewGraph.from_edges(
        np.arange(frames), edges, se3.inverse(true[:-1]) @ true[1:], 1e4 * np.tile(np.eye(6), (39, 1, 1))
    )
    odometry = se3.inverse(true[0]) @ true
    fixes = fixes_at(true, np.arange(frames))
    if exact:
        fixes = replace(fixes, points=true[:, :3, 3], stated=np.zeros(frames, bool))
    found = place(graph, odometry, np.zeros(frames, np.int64), np.ones(39), fixes, UP)
    assert found.world_from_cam[:, 2, 2].min() > np.cos(np.radians(15))


@pytest.mark.parametrize(("nearest_z", "up"), [(0.5, [0, -1, 0]), (-1.0, [0, 0, 1])])
def test_clouds_tell_which_way_their_sensor_is_up(nearest_z: float, up: list[float]) -> None:
    """A depth camera's clouds have no point behind it, a scanner's have the ground."""
    points = np.random.default_rng(0).uniform([-1, -1, nearest_z], [1, 1, 2], (100, 3)).astype(np.float32)
    scene = SimpleNamespace(clouds=CloudSet.from_clouds([PointCloud(points)]))
    work = Work(None, None, scene, None, None)  # type: ignore[arg-type]
    np.testing.assert_array_equal(work._up(np.eye(4)[None]), up)


def test_points_are_aligned_in_spite_of_wrong_ones() -> None:
    rng = np.random.default_rng(3)
    known = rng.normal(0, 20, (40, 3))
    motion = se3.exp(np.array([0.3, -2.0, 1.0, 5, 6, 7]))
    found = se3.transform(motion, known)
    known[:12] += rng.normal(0, 40, (12, 3))
    aligned, inliers = align_positions(found, known, np.full(40, 0.05), motion[:3, 2])
    assert inliers[12:].all() and not inliers[:12].any()
    assert se3.transform(aligned, found[12:]) == pytest.approx(known[12:], abs=1e-6)


def test_positions_that_are_off_by_the_same_for_long_are_rejected() -> None:
    graph, odometry, true = drifting_loop(frames=75)
    fixes = fixes_at(true, np.arange(75))
    off = (np.arange(75) >= 25) & (np.arange(75) < 50)
    fixes.points[off] += [20.0, 0, 0]
    found = place(graph, odometry, np.zeros(75, np.int64), np.ones(graph.edge_count), fixes, UP)
    assert np.array_equal(~found.fit.used, off)
    assert np.linalg.norm((found.world_from_cam - true)[:, :3, 3], axis=1).max() < 3 * SIGMA_M


def test_positions_off_for_long_are_rejected_where_a_loop_joins_what_is_around_them() -> None:
    graph, odometry, true = drifting_loop(frames=150)
    loops = np.stack([np.arange(9), np.arange(141, 150)], axis=1)
    noise = np.random.default_rng(6).normal(0, 1, (9, 6)) * ([1e-3] * 3 + [0.03] * 3)
    joins = se3.inverse(true[loops[:, 0]]) @ true[loops[:, 1]] @ se3.exp(noise)
    edges, motions = np.concatenate([graph.edges, loops]), np.concatenate([graph.i_from_j, joins])
    information = np.tile(graph.information[0], (len(edges), 1, 1))
    closed = ViewGraph.from_edges(np.arange(150), edges, motions, information)
    fixes = fixes_at(true, np.arange(150))
    off = (np.arange(150) >= 50) & (np.arange(150) < 80)
    fixes.points[off] += [12.0, 0, 0]
    found = place(closed, odometry, np.zeros(150, np.int64), np.ones(len(edges)), fixes, UP)
    assert np.array_equal(~found.fit.used, off)
    assert np.linalg.norm((found.world_from_cam - true)[:, :3, 3], axis=1).max() < 3 * SIGMA_M


def test_positions_stay_where_odometry_slipped() -> None:
    graph, odometry, true = drifting_loop(frames=120)
    slip = np.eye(4)
    slip[0, 3] = 8.0
    over = (graph.edges[:, 0] < 60) & (graph.edges[:, 1] >= 60)
    motions = np.where(over[:, None, None], graph.i_from_j @ slip, graph.i_from_j)
    odometry = np.concatenate([odometry[:60], odometry[60:] @ slip])
    fixes = fixes_at(true, np.arange(120))
    slipped = replace(graph, i_from_j=motions)
    found = place(slipped, odometry, np.zeros(120, np.int64), np.ones(graph.edge_count), fixes, UP)
    assert found.fit.used.mean() > 0.95
