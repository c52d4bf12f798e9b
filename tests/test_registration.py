"""Every registrar on clouds whose motion is known; information, fitness, degenerate input."""

import numpy as np
import pytest

from hodge_pipeline import registry, se3
from hodge_pipeline.executors.local import LocalExecutor
from hodge_pipeline.registration.assessment import assess
from hodge_pipeline.registration.gicp import Gicp, PreparedCloud
from hodge_pipeline.types import PointCloud, Registration

NAMES = registry.names("registration")


def corner(seed: int, count: int = 16000) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points, normals and colours of a room corner with a box in it: three walls, three faces."""
    rng = np.random.default_rng(seed)
    points, normals = [], []
    for centre, size in (((0.0, 0.0, 2.5), 2.0), ((0.3, 0.4, 1.9), 0.5)):
        for axis in range(3):
            face = rng.uniform(-size / 2, size / 2, (count // 6, 3))
            face[:, axis] = size / 2 if size > 1 else -size / 2
            points.append(face + centre)
            normals.append(np.tile(-np.eye(3)[axis], (len(face), 1)))
    stacked = np.concatenate(points)
    stripes = (np.sin(stacked @ np.array([9.0, 7.0, 5.0])) > 0) * 200 + 30
    return stacked, np.concatenate(normals), np.repeat(stripes[:, None], 3, axis=1).astype(np.uint8)


def seen_from(world_from_cam: np.ndarray, seed: int, noise_m: float = 0.002) -> PointCloud:
    """The corner as a camera at this pose sees it, sampled and disturbed anew."""
    points, normals, colours = corner(seed)
    cam_from_world = se3.inverse(world_from_cam)
    noise = np.random.default_rng(seed).normal(scale=noise_m, size=points.shape)
    return PointCloud(
        se3.transform(cam_from_world, points + noise).astype(np.float32),
        (normals @ cam_from_world[:3, :3].T).astype(np.float32),
        colours,
    )


WORLD_FROM_I = se3.exp(np.array([0.02, -0.1, 0.05, 0.1, 0.0, -0.1]))
WORLD_FROM_J = se3.exp(np.array([0.05, 0.06, -0.04, -0.05, 0.1, 0.05]))
I_FROM_J = se3.inverse(WORLD_FROM_I) @ WORLD_FROM_J
OFF = se3.exp(np.array([0.03, -0.03, 0.02, 0.04, -0.03, 0.03]))


def register(name: str, guess: np.ndarray = I_FROM_J @ OFF) -> Registration:
    registrar = registry.load("registration", name)()
    target, source = seen_from(WORLD_FROM_I, 1), seen_from(WORLD_FROM_J, 2)
    return registrar.register(registrar.prepare(target), registrar.prepare(source), guess)


@pytest.mark.parametrize("name", NAMES)
def test_the_known_motion_is_found(name: str) -> None:
    found = register(name)
    error = se3.log(se3.inverse(I_FROM_J) @ found.i_from_j)
    assert np.linalg.norm(error[:3]) < 0.01
    assert np.linalg.norm(error[3:]) < 0.01
    assert found.converged
    assert found.fitness > 0.9
    assert 0 < found.rmse_m < 0.1
    assert found.correspondences > 500
    # it moves cloud j onto cloud i: the other way round is far off
    assert np.linalg.norm(se3.log(se3.inverse(se3.inverse(I_FROM_J)) @ found.i_from_j)) > 0.1


def test_every_worker_gives_the_same_bits() -> None:
    """In worker processes, where open3d is kept to one thread."""
    results: dict[str, list[Registration]] = {}
    with LocalExecutor(workers=2).open() as workers:
        for row, found in workers.map(register, NAMES * 3):
            results.setdefault((NAMES * 3)[row], []).append(found)
    for name, (first, *others) in results.items():
        for other in others:
            np.testing.assert_array_equal(first.i_from_j, other.i_from_j, err_msg=name)
            np.testing.assert_array_equal(first.information, other.information, err_msg=name)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("case", ["not finite", "one point repeated"])
def test_degenerate_clouds_are_unregistered_not_a_crash(name: str, case: str) -> None:
    registrar = registry.load("registration", name)()
    target = seen_from(WORLD_FROM_I, 1)
    points = {
        "not finite": np.full((50, 3), np.nan, np.float32),
        "one point repeated": np.ones((50, 3), np.float32) * 80,
    }[case]
    source = PointCloud(points, np.zeros_like(points), np.zeros(points.shape, np.uint8))
    found = registrar.register(registrar.prepare(target), registrar.prepare(source), np.eye(4))
    assert found.fitness < 0.3
    assert se3.is_motion(found.i_from_j)
    assert np.isfinite(found.information).all()
    assert not found.converged or found.correspondences > 0


@pytest.mark.parametrize("name", NAMES)
def test_clouds_too_small_to_align_print_nothing(name: str, capfd: pytest.CaptureFixture[str]) -> None:
    registrar = registry.load("registration", name)()
    whole = seen_from(WORLD_FROM_I, 1)
    few = PointCloud(*(array[:10] for array in (whole.points_in_cam, whole.normals_in_cam, whole.colours)))
    for target, source in ((whole, few), (few, whole)):
        found = registrar.register(registrar.prepare(target), registrar.prepare(source), np.eye(4))
        assert not found.converged and not found.correspondences
    assert capfd.readouterr() == ("", "")


def test_aligned_both_ways_neither_cloud_is_preferred() -> None:
    def differ(both_ways: bool) -> tuple[float, float, float]:
        registrar = Gicp(both_ways=both_ways)
        i, j = (registrar.prepare(seen_from(pose, seed, 0.02)) for pose, seed in ((WORLD_FROM_I, 1), (WORLD_FROM_J, 2)))
        forth = registrar.register(i, j, I_FROM_J @ OFF)
        back = registrar.register(j, i, se3.inverse(I_FROM_J @ OFF))
        moved = float(np.abs(se3.log(forth.i_from_j @ back.i_from_j)).max())
        in_j = se3.pull_back(forth.i_from_j, back.information)
        return moved, float(np.abs(in_j / forth.information - 1).max()), abs(back.fitness - forth.fitness)

    both, one = differ(both_ways=True), differ(both_ways=False)
    assert all(x < 0.3 * y for x, y in zip(both, one, strict=True)), (both, one)


def test_a_plane_leaves_three_directions_without_information() -> None:
    rng = np.random.default_rng(0)
    wall = np.column_stack([rng.uniform(-1, 1, (2000, 2)), np.full(2000, 2.0)]).astype(np.float32)
    normals = np.tile(np.array([[0, 0, -1]], np.float32), (2000, 1))
    cloud = Gicp().prepare(PointCloud(wall, normals))
    found = Gicp().register(cloud, cloud, np.eye(4))
    eigenvalues = np.linalg.eigvalsh(found.information)
    assert (eigenvalues[:3] < 1e-6 * eigenvalues[3:].min()).all()


def test_noise_of_normals_feigns_no_constraint_along_a_wall() -> None:
    clouds = []
    for seed in (1, 2):
        rng = np.random.default_rng(seed)
        wall = np.column_stack([rng.uniform(-1, 1, (4000, 2)), rng.normal(2.0, 0.003, 4000)]).astype(np.float32)
        normals = np.array([0, 0, -1]) + rng.normal(0, 0.15, (4000, 3)) * [1, 1, 0]
        normals /= np.linalg.norm(normals, axis=1)[:, None]
        clouds.append(Gicp().prepare(PointCloud(wall, normals.astype(np.float32))))
    along_x, along_y, across = np.diag(Gicp().register(clouds[0], clouds[1], np.eye(4)).information)[3:]
    assert max(along_x, along_y) < 0.15**2 / 5 * across  # by the normals of one cloud alone it is 0.15**2 of it


def test_information_is_the_second_derivative_of_the_point_to_plane_error() -> None:
    target, source = PreparedCloud(seen_from(WORLD_FROM_I, 1), 10), PreparedCloud(seen_from(WORLD_FROM_J, 2), 10)

    def errors(motion: np.ndarray, rows: np.ndarray) -> np.ndarray:
        moved = se3.transform(motion, source.points)
        return np.asarray(np.einsum("ij,ij->i", target.normals[rows], moved - target.points[rows]))

    rows, squared = target.find_nearest(se3.transform(I_FROM_J, source.points))
    near = squared < 0.1**2
    step = 1e-4
    columns = [
        (errors(I_FROM_J @ se3.exp(step * axis), rows) - errors(I_FROM_J @ se3.exp(-step * axis), rows)) / (2 * step)
        for axis in np.eye(6)
    ]
    jacobian = np.stack(columns, axis=1)[near]
    variance = np.mean(errors(I_FROM_J, rows)[near] ** 2)
    same = target.normals[rows] @ I_FROM_J[:3, :3]  # normals without noise: those of both clouds are the same
    found = assess(
        target.find_nearest, target.points, target.normals, source.points, same, I_FROM_J,
        max_distance_m=0.1, points_per_sample=50.0,
    )  # fmt: skip
    expected = jacobian.T @ jacobian / (variance * 50.0)
    np.testing.assert_allclose(found.information, expected, rtol=1e-5, atol=1e-6 * expected.max())


def test_ndt_comes_as_far_as_its_voxels_are_wide() -> None:
    corner = np.random.default_rng(4).uniform(0, 3, (3, 4000, 3))
    for axis, wall in enumerate(corner):
        wall[:, axis] = 0
    errors = {}
    for side_m in (0.5, 0.02):
        registrar = registry.load("registration", "ndt")(voxels_m=(side_m,))
        prepared = registrar.prepare(PointCloud(np.float32(np.vstack(corner))))
        errors[side_m] = np.abs(registrar.register(prepared, prepared, se3.exp(np.full(6, 0.05))).i_from_j[:3, 3]).max()
    assert errors[0.5] < 0.005 < 0.04 < errors[0.02]


def poster(count: int, seed: int) -> PointCloud:
    """A plane with a pattern."""
    flat = np.column_stack([np.random.default_rng(seed).uniform(-1, 1, (count, 2)), np.full(count, 2.0)])
    pattern = (np.sin(6 * flat[:, 0]) * np.cos(5 * flat[:, 1]) * 100 + 128).astype(np.uint8)
    normals = np.tile(np.array([[0, 0, -1]], np.float32), (count, 1))
    return PointCloud(flat.astype(np.float32), normals, np.repeat(pattern[:, None], 3, axis=1))


@pytest.mark.parametrize(("least_m", "off_m"), [(0.005, 0.04), (0.1, 0.0)])
def test_colours_are_matched_so_far_apart_that_points_have_neighbours(least_m: float, off_m: float) -> None:
    registrar = registry.load("registration", "coloured_icp")(distances_m=(0.005,), min_distance_m=least_m)
    target, source = (registrar.prepare(poster(2000, seed)) for seed in (0, 1))
    found = registrar.register(target, source, se3.exp(np.array([0, 0, 0, 0.04, 0, 0])))
    assert found.i_from_j[0, 3] == pytest.approx(off_m, abs=0.002)


def test_colours_hold_where_the_surface_slides() -> None:
    cloud = poster(6000, 3)
    guess = se3.exp(np.array([0, 0, 0, 0.04, 0, 0]))
    results = {}
    for name in ("coloured_icp", "point_to_plane"):
        registrar = registry.load("registration", name)(distances_m=(0.1,))
        prepared = registrar.prepare(cloud)
        results[name] = abs(registrar.register(prepared, prepared, guess).i_from_j[0, 3])
    assert results["coloured_icp"] < 0.01 < results["point_to_plane"]
