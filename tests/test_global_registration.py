"""Registration with no guess: right among many wrong matches, the same every time, honest about what it cannot see."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hodge_pipeline import se3
from hodge_pipeline.executors.local import InProcess
from hodge_pipeline.registration.consensus import rigid_consensus
from hodge_pipeline.registration.global_evidence import (
    STREET_SCALE,
    depth_view,
    free_directions,
    free_space,
    panorama,
    violation,
)
from hodge_pipeline.registration.global_features import describe, mutual_matches, viewpoint
from hodge_pipeline.registration.global_pairs import describe_clouds, load_description
from hodge_pipeline.registration.global_registrars import FpfhConsensus
from hodge_pipeline.start.unordered.hypotheses import LEAD_SIGMAS
from hodge_pipeline.types import Camera, CloudSet, Floats, PointCloud

CAMERA = Camera(160, 120, 100.0, 100.0, 80.0, 60.0)


def furnished_corner(seed: int, count: int = 30_000) -> Floats:
    """Points (N, 3) on three walls, a box and a ball: no motion maps it onto itself."""
    rng = np.random.default_rng(seed)
    flat = rng.uniform(0, 2.0, (count, 2))
    zero = np.zeros(count)
    u, v = flat.T
    walls = [np.column_stack(columns) for columns in ((u, v, zero), (zero, u, v), (u, zero, v))]
    size = np.array([0.5, 0.3, 0.7])
    box = rng.uniform(0, 1, (count // 2, 3))
    side = rng.integers(0, 3, len(box))
    box[np.arange(len(box)), side] = box[np.arange(len(box)), side].round()
    ball = rng.normal(size=(count // 3, 3))
    ball = 0.3 * ball / np.linalg.norm(ball, axis=1, keepdims=True)
    return np.concatenate([*walls, size * box + [0.9, 0.4, 0.0], ball + [0.5, 1.4, 0.6]])


def cloud_of(points: Floats) -> PointCloud:
    return PointCloud(points.astype(np.float32))


def off_by(found: Floats, truth: Floats) -> tuple[float, float]:
    """Metres and degrees."""
    error = se3.inverse(truth) @ found
    return float(np.linalg.norm(error[:3, 3])), float(np.degrees(np.linalg.norm(se3.so3_log(error[:3, :3]))))


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 1000), st.floats(-3, 3), st.floats(-3, 3), st.integers(0, 170))
def test_consensus_finds_the_motion_among_wrong_matches(seed: int, angle: float, shift: float, wrong: int) -> None:
    rng = np.random.default_rng(seed)
    motion = se3.exp(np.array([angle / 2, -angle / 3, angle / 4, shift, -shift, 0.5]))
    source = rng.uniform(-2, 2, (200, 3))
    target = se3.transform(motion, source) + rng.normal(scale=0.003, size=source.shape)
    target[30:][:wrong] = rng.uniform(-4, 4, (wrong, 3))
    found = rigid_consensus(target, source, 0.05)
    metres, degrees = off_by(found.i_from_j, motion)
    assert metres < 0.02 and degrees < 0.5
    assert found.inlier[:30].all() and found.count >= 200 - wrong


def test_consensus_of_too_few_matches_says_nothing() -> None:
    found = rigid_consensus(np.zeros((3, 3)), np.zeros((3, 3)), 0.1)
    assert found.count == 0 and np.array_equal(found.i_from_j, np.eye(4)) and found.inlier.shape == (3,)


@pytest.mark.parametrize(("second", "is_rival"), [(60, True), (20, False)])
def test_a_second_motion_among_the_matches_is_counted(second: int, is_rival: bool) -> None:
    rng = np.random.default_rng(3)
    here, there = np.eye(4), se3.exp(np.array([0, 0, 1.0, 2.0, 0, 0]))
    source = rng.uniform(-2, 2, (70 + second, 3))
    target = np.concatenate([se3.transform(here, source[:70]), se3.transform(there, source[70:])])
    found = rigid_consensus(target, source, 0.05)
    assert found.count == 70 and second <= found.rival_count <= second + 3
    assert (found.count - found.rival_count < LEAD_SIGMAS * np.sqrt(found.rival_count)) == is_rival


def test_random_matches_hardly_agree() -> None:
    rng = np.random.default_rng(0)
    found = rigid_consensus(rng.uniform(0, 4, (600, 3)), rng.uniform(0, 4, (600, 3)), 0.075)
    assert found.count < 15  # the least that an edge needs


def test_a_motion_far_from_the_identity_is_found() -> None:
    registrar = FpfhConsensus()
    first, second = (se3.exp(np.array(xi)) for xi in ([0.4, -1.3, 0.7, 1.0, 1.2, 1.5], [-0.5, 0.2, 2.0, 1.4, 0.9, 1.1]))
    scene, again = (
        registrar.describe(cloud_of(se3.transform(se3.inverse(pose), furnished_corner(seed))))
        for seed, pose in enumerate((first, second))
    )
    found = registrar.match(scene, again)
    metres, degrees = off_by(found.i_from_j, se3.inverse(first) @ second)
    assert metres < 0.1 and degrees < 4 and found.inliers >= 15
    assert np.array_equal(found.i_from_j, registrar.match(scene, again).i_from_j)


def test_the_origin_of_a_scan_may_lie_anywhere() -> None:
    motion = se3.exp(np.array([0.4, -1.3, 0.7, 10.0, -20.0, 5]))
    here, there = furnished_corner(1) + [3.0, -4.0, -1.0], furnished_corner(2) + [3.0, -4.0, -1.0]
    registrar = FpfhConsensus()
    target = registrar.describe(cloud_of(here))
    source = registrar.describe(cloud_of(se3.transform(se3.inverse(motion), there)))
    found = registrar.match(target, source)
    moved = se3.transform(found.i_from_j @ se3.inverse(motion), there)
    assert np.linalg.norm(moved - there, axis=1).max() < 0.1


@pytest.mark.parametrize("count", [0, 5])
def test_a_handful_of_points_matches_nothing(count: int) -> None:
    registrar = FpfhConsensus()
    few = registrar.describe(cloud_of(np.eye(5, 3)[:count]))
    scene = registrar.describe(cloud_of(furnished_corner(1)))
    for target, source in ((few, scene), (scene, few), (few, few)):
        assert registrar.match(target, source).inliers == 0


def test_matches_are_mutual_and_the_nearest_come_first() -> None:
    described = describe(cloud_of(furnished_corner(1)), 0.05)
    rows = mutual_matches(described, described)
    assert len(rows) > 0.5 * len(described)
    assert (described.features[rows[:20, 0]] == described.features[rows[:20, 1]]).all()


def sphere(rng: np.random.Generator) -> tuple[Floats, Floats]:
    normals = rng.normal(size=(4000, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return normals + [5.0, 0, 0], normals


def plane(rng: np.random.Generator) -> tuple[Floats, Floats]:
    points = rng.uniform(-1, 1, (4000, 3)) * [1.0, 2.0, 0.0]
    return points + [0, 0, 7.0], np.tile([0.0, 0, 1], (4000, 1))


def cylinder(rng: np.random.Generator) -> tuple[Floats, Floats]:
    angle, height = rng.uniform(0, 2 * np.pi, 4000), rng.uniform(-2, 2, 4000)
    normals = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(4000)])
    return normals + np.column_stack([np.zeros((4000, 2)), height]), normals


@pytest.mark.parametrize(
    ("shape", "turning", "sliding"),
    [(plane, 1, 2), (sphere, 3, 0), (cylinder, 1, 1)],
    ids=["plane", "sphere", "cylinder"],
)
def test_free_directions_of_known_shapes(shape: object, turning: int, sliding: int) -> None:
    free = free_directions(*shape(np.random.default_rng(0)))  # type: ignore[operator]
    assert sum("turning" in one for one in free) == turning
    assert sum("sliding" in one for one in free) == sliding
    if shape is plane:
        assert "turning about (0.00, 0.00, 1.00)" in free


def test_a_corner_leaves_nothing_free() -> None:
    points = np.random.default_rng(0).uniform(0, 1, (3000, 3))
    normals = np.eye(3)[np.arange(3000) % 3]
    points[np.arange(3000), np.arange(3000) % 3] = 0
    assert free_directions(points, normals) == ()


def wall(depth_m: float) -> Floats:
    """The points of a wall that fills the view, facing the camera."""
    column, row = np.meshgrid(np.arange(0, 160, 4.0), np.arange(0, 120, 4.0))
    rays = np.column_stack([(column.ravel() - 80) / 100, (row.ravel() - 60) / 100, np.ones(column.size)])
    return depth_m * rays


def test_points_before_the_surface_violate_and_those_behind_do_not() -> None:
    view = depth_view(np.full((120, 160), 2.0, np.float32), CAMERA)
    assert free_space(view, wall(1.0)).violation == 1.0
    assert free_space(view, wall(2.0)).violation == 0.0
    behind = free_space(view, wall(3.0))
    assert behind.before == 0 and np.isnan(behind.violation)
    assert np.isnan(free_space(view, -wall(2.0)).violation)


def test_pixels_without_a_measurement_accuse_nobody() -> None:
    view = depth_view(np.zeros((120, 160), np.float32), CAMERA)
    assert np.isnan(free_space(view, wall(1.0)).violation)


def hall(half_m: float) -> Floats:
    """The walls of a square hall of this half side round the origin, 2 m up and down."""
    at, up = (grid.ravel() for grid in np.meshgrid(np.linspace(-1, 1, 400), np.linspace(-2, 2, 60)))
    sides = [np.stack([np.full(at.size, side), at, up / half_m], axis=1) for side in (-1.0, 1.0)]
    return half_m * np.concatenate([*sides, *(points[:, [1, 0, 2]] for points in sides)])


def test_a_scanner_saw_through_what_stands_before_its_walls() -> None:
    view = panorama(hall(5.0))
    assert free_space(view, hall(5.0)).violation == 0.0
    assert free_space(view, hall(4.0)).violation == 1.0
    assert np.isnan(free_space(view, hall(6.0)).violation)  # behind the walls
    quarter = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    assert free_space(view, hall(5.0) @ quarter.T).violation == 0.0
    moved = hall(5.0) + np.array([2.0, 0.0, 0.0])
    assert 0.15 < free_space(view, moved).violation < 0.5  # one wall of four, and the ends of two
    assert not np.isfinite(view.nearest_m[:3]).any()  # nothing was measured overhead: it accuses nobody


def test_vehicles_that_drove_on_refute_no_street() -> None:
    ahead = np.stack([np.full(600, 12.0), *np.random.default_rng(0).uniform(-2, 2, (2, 600))], axis=1)
    aside = ahead @ se3.so3_exp(np.array([[0, 0, np.pi / 4]]))[0].T
    now = np.concatenate([10 * hall(5.0)[::8], ahead, aside])
    view = panorama(10 * hall(5.0))
    assert free_space(view, now, STREET_SCALE).violation == 0.0
    assert free_space(view, now, 0.9 * STREET_SCALE).violation > 0.09  # of two equal rooms furniture tells
    assert free_space(view, 6 * hall(5.0)[::8], STREET_SCALE).violation == 1.0  # another place
    assert free_space(view, ahead, STREET_SCALE).violation == 1.0  # nothing but a vehicle in common: no proof


def test_a_scanner_saw_through_nothing_below_its_lowest_beam() -> None:
    down, turn = np.radians(np.linspace(2, 24, 64)), np.linspace(0, 2 * np.pi, 400, endpoint=False)
    ring_m, around = (grid.ravel() for grid in np.meshgrid(1.8 / np.tan(down), turn))
    ground = np.column_stack([ring_m * np.cos(around), ring_m * np.sin(around), np.full(len(ring_m), -1.8)])
    found = free_space(panorama(ground), ground + np.array([1.0, 0.0, 0.0]))
    assert found.on > 400 and found.before == 0


def test_a_scan_of_the_ground_is_seen_from_its_scanner() -> None:
    beams, turn = np.radians(np.linspace(-24, -2, 32)), np.linspace(0, 2 * np.pi, 400, endpoint=False)
    up, round_ = (grid.ravel() for grid in np.meshgrid(beams, turn))
    flat_m = -1.8 / np.tan(up)
    ground = np.stack([flat_m * np.cos(round_), flat_m * np.sin(round_), np.full(up.size, -1.8)], axis=1)
    assert not viewpoint(ground).any()


def test_no_sensor_is_nearer_to_an_object_than_sensors_measure() -> None:
    tile = np.append(np.random.default_rng(0).uniform(-0.05, 0.05, (500, 2)), np.full((500, 1), 0.08), axis=1)
    assert (viewpoint(tile) == tile.mean(axis=0)).all()
    assert not viewpoint(3 * tile).any(), "far enough away"
    hull = np.concatenate([3 * tile, np.full((20, 3), 0.01)])
    assert not viewpoint(hull).any(), "a few points, as of the scanner's own mount"


def test_violation_is_the_worse_of_the_two_views() -> None:
    near, far = (
        depth_view(np.full((120, 160), 1.0, np.float32), CAMERA),
        depth_view(np.full((120, 160), 3.0, np.float32), CAMERA),
    )
    assert violation((near, far), (wall(1.0), wall(3.0)), np.eye(4)) == 1.0
    assert violation((near, near), (wall(1.0), wall(1.0)), np.eye(4)) == 0.0


def test_real_fragments_are_registered_with_no_guess(data_dir: Path) -> None:
    from hodge_adapters.clouds.fragments import Fragment, read_fragment
    from hodge_adapters.trajectories.log import read_log_file

    fragments = data_dir / "fragments"
    truth = read_log_file(fragments / "pair_estimates/7-scenes-redkitchen-evaluation/gt.log")
    wanted = truth.i_from_j[np.flatnonzero((truth.pairs == (1, 3)).all(axis=1))[0]]
    registrar = FpfhConsensus()
    described = [
        registrar.describe(read_fragment(Fragment(fragments / f"redkitchen_3dmatch/cloud_bin_{number}.ply")))
        for number in (1, 3)
    ]
    found = registrar.match(*described)
    metres, degrees = off_by(found.i_from_j, wanted)
    assert metres < 0.1 and degrees < 4 and found.inliers > 50


def test_clouds_that_are_described_anew_are_not_matched_as_they_were(tmp_path: Path) -> None:
    for count in (3000, 6000):  # two runs of one process, into the same folder
        folder = tmp_path / "clouds"
        folder.mkdir(exist_ok=True)
        cloud = PointCloud(furnished_corner(0, count).astype(np.float32))
        CloudSet.from_clouds([cloud]).save(folder)
        describe_clouds(folder, FpfhConsensus(), np.zeros(1, np.int64), tmp_path / "described", InProcess())
        assert len(load_description(tmp_path / "described", 0)) == len(describe(cloud, FpfhConsensus().voxel_m))
