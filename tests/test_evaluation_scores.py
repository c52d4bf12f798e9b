"""Scores against brute force, by hand, and on real frames."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hodge_pipeline import se3
from hodge_pipeline.errors import GraphError
from hodge_pipeline.evaluation import scores
from hodge_pipeline.evaluation.cloud_distance import NO_NEIGHBOUR_M, REACH_M
from hodge_pipeline.evaluation.residuals import edge_residuals
from hodge_pipeline.evaluation.scores import (
    PAIRS_PER_BLOCK,
    SIGMA_M,
    edge_distances,
    evaluation_pairs,
    score_table,
)
from hodge_pipeline.types import CloudSet, Floats, Ints, PointCloud, ViewGraph


class Inline:
    """Workers that do the work here, last block first: results may come in any order."""

    def map(self, task: Callable[[Any], Any], blocks: Sequence[Any]) -> Iterator[tuple[int, Any]]:
        for index in reversed(range(len(blocks))):
            yield index, task(blocks[index])


def random_clouds(count: int, seed: int = 0) -> CloudSet:
    rng = np.random.default_rng(seed)

    def cloud() -> PointCloud:
        normals = rng.normal(size=(300, 3))
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        return PointCloud(rng.uniform(0, 1, (300, 3)).astype(np.float32), normals.astype(np.float32))

    return CloudSet.from_clouds([cloud() for _ in range(count)])


def square(height: float, shift: float = 0.0) -> PointCloud:
    """A square of a metre, a point every 5 cm, at this height; its normals point up."""
    x, y = np.meshgrid(np.arange(0.025, 1, 0.05), np.arange(0.025, 1, 0.05))
    points = np.stack([x.ravel() + shift, y.ravel(), np.full(x.size, height)], axis=1)
    return PointCloud(points.astype(np.float32), np.tile(np.float32([0, 0, 1]), (x.size, 1)))


def brute_force(clouds: CloudSet, i: int, j: int, world_from_cam: Floats) -> float:
    i_from_j = np.linalg.inv(world_from_cam[i]) @ world_from_cam[j]
    total, count = 0.0, 0
    for p in clouds[j].points_in_cam.astype(float) @ i_from_j[:3, :3].T + i_from_j[:3, 3]:
        gaps = np.linalg.norm(clouds[i].points_in_cam - p, axis=1)
        nearest = gaps.argmin()
        if gaps[nearest] <= REACH_M:
            total += abs(clouds[i].normals_in_cam[nearest] @ (p - clouds[i].points_in_cam[nearest]))
            count += 1
    return total / count if count else NO_NEIGHBOUR_M


def saved(clouds: CloudSet, folder: Path) -> Path:
    clouds.save(folder)
    return folder


def identities(count: int) -> Floats:
    return np.tile(np.eye(4), (count, 1, 1))


def test_distances_equal_brute_force(tmp_path: Path) -> None:
    clouds = random_clouds(5)
    poses = se3.exp(np.random.default_rng(1).normal(scale=0.2, size=(2, 5, 6)))
    pairs = np.array([(3, 4), (0, 1), (2, 0), (0, 4), (1, 2)])
    found = edge_distances(saved(clouds, tmp_path), pairs, poses, Inline())
    expected = [[brute_force(clouds, i, j, world_from_cam) for i, j in pairs] for world_from_cam in poses]
    np.testing.assert_allclose(found, expected, rtol=1e-6)


def test_parallel_squares_are_as_far_apart_as_their_heights(tmp_path: Path) -> None:
    clouds = CloudSet.from_clouds([square(0.0), square(0.03), square(0.3)])
    found = edge_distances(saved(clouds, tmp_path), np.array([(0, 1), (0, 2)]), identities(3), Inline())
    np.testing.assert_allclose(found, [0.03, NO_NEIGHBOUR_M], rtol=1e-6)


def test_sliding_along_the_plane_costs_nothing(tmp_path: Path) -> None:
    poses = identities(2)
    poses[1, 0, 3] = 0.4
    clouds = CloudSet.from_clouds([square(0.0), square(0.0)])
    assert edge_distances(saved(clouds, tmp_path), np.array([(0, 1)]), poses, Inline()) == pytest.approx(0, abs=1e-7)


def test_of_a_large_cloud_some_points_are_measured_evenly(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bumpy = square(0.01)
    bumpy.points_in_cam[1::4, 2] = 0.05
    folder = saved(CloudSet.from_clouds([square(0.0), bumpy]), tmp_path)
    monkeypatch.setattr(scores, "LEAST_POINTS", 10)
    monkeypatch.setattr(scores, "MOST_POINTS", 800)
    for pairs, mean_m in ((2, 0.02), (8, 0.01)):  # 400 points of each: all; 100 of each: every fourth
        found = edge_distances(folder, np.array([(0, 1)] * pairs), identities(2), Inline())
        np.testing.assert_allclose(found, mean_m, atol=1e-7)


def test_moving_the_world_changes_no_distance(tmp_path: Path) -> None:
    folder, pairs = saved(random_clouds(4), tmp_path), np.array([(0, 1), (1, 3), (2, 3)])
    poses = se3.exp(np.random.default_rng(2).normal(scale=0.1, size=(4, 6)))
    moved = se3.exp(np.array([0.3, -1.0, 2.0, 5.0, -3.0, 1.0])) @ poses
    here, there = (edge_distances(folder, pairs, world_from_cam, Inline()) for world_from_cam in (poses, moved))
    np.testing.assert_allclose(here, there, rtol=1e-9)


def test_a_frame_without_points_or_pose_has_no_edges_and_no_false_distance(tmp_path: Path) -> None:
    empty = PointCloud(np.zeros((0, 3), np.float32))
    clouds = CloudSet.from_clouds([square(0.0), empty, square(0.02), square(0.01)])
    poses = identities(4)
    poses[3] = np.nan
    assert evaluation_pairs(clouds, poses, "distance").tolist() == [[0, 2]]
    assert evaluation_pairs(clouds, poses, "iou").tolist() == [[0, 2]]
    pairs = np.array([(0, 1), (1, 2), (0, 3)])
    found = edge_distances(saved(clouds, tmp_path), pairs, poses, Inline())
    np.testing.assert_array_equal(found, [NO_NEIGHBOUR_M, NO_NEIGHBOUR_M, np.nan])


def test_iou_counts_shared_voxels() -> None:
    # Ten by ten voxels of 0.1 m each; a shift by k columns shares 100 − 10k of 100 + 10k: above a half up to k = 3.
    clouds = CloudSet.from_clouds([square(0.05, shift) for shift in (0.0, 0.3, 0.4)])
    assert evaluation_pairs(clouds, identities(3), "iou").tolist() == [[0, 1], [1, 2]]


@pytest.mark.parametrize("kind", ["distance", "iou"])
def test_of_many_frames_the_pairs_of_some_are_scored(kind: scores.GraphKind, monkeypatch: pytest.MonkeyPatch) -> None:
    clouds = CloudSet.from_clouds([square(0.0)] * 6)
    assert len(evaluation_pairs(clouds, identities(6), kind)) == 15
    monkeypatch.setattr(scores, "MOST_FRAMES", 2)
    some = [[0, 1], [0, 2], [0, 3], [0, 4], [0, 5], [1, 5], [2, 5], [3, 5], [4, 5]]
    assert evaluation_pairs(clouds, identities(6), kind).tolist() == some


def test_the_distance_graph_joins_near_centroids() -> None:
    clouds = CloudSet.from_clouds([square(0.0, shift) for shift in (0.0, 0.19, 0.4)])
    assert evaluation_pairs(clouds, identities(3), "distance").tolist() == [[0, 1]]


def test_no_pairs_give_an_empty_table(tmp_path: Path) -> None:
    clouds = CloudSet.from_clouds([square(0.0), square(0.0, 5.0)])
    poses = identities(2)
    table = score_table(saved(clouds, tmp_path), {"result": poses}, "result", Inline())
    assert [graph.counts.tolist() for graph in table.graphs] == [[0], [0]]
    assert np.isnan(table.graphs[0].mean_score).all()


def test_the_table_scores_every_set_on_the_edges_of_the_reference(tmp_path: Path) -> None:
    clouds = CloudSet.from_clouds([square(0.0), square(0.0), square(0.0)])
    drifted, partial = identities(3), identities(3)
    drifted[1, 2, 3] = 0.04
    partial[2] = np.nan
    sets = {"truth": identities(3), "odometry": drifted, "part": partial}
    table = score_table(saved(clouds, tmp_path), sets, "truth", Inline())
    graph = table.graphs[0]
    assert graph.pairs.tolist() == [[0, 1], [0, 2], [1, 2]]
    assert graph.counts.tolist() == [3, 3, 1]
    np.testing.assert_allclose(graph.mean_distance_m, [0, 0.08 / 3, 0], atol=1e-8)
    np.testing.assert_allclose(graph.mean_score, [1, (2 * np.exp(-0.04 / SIGMA_M) + 1) / 3, 1], rtol=1e-6)


def test_unequal_numbers_and_unknown_names_are_refused(tmp_path: Path) -> None:
    clouds = random_clouds(2)
    with pytest.raises(GraphError, match="2 clouds but 3 poses"):
        evaluation_pairs(clouds, identities(3), "iou")
    with pytest.raises(GraphError, match="'truth' are not among result"):
        score_table(saved(clouds, tmp_path), {"result": identities(2)}, "truth", Inline())


def test_pairs_of_several_blocks_are_all_measured(tmp_path: Path) -> None:
    pairs = np.array([(i, j) for i in range(20) for j in range(i + 1, 20)])
    assert len(pairs) > PAIRS_PER_BLOCK
    clouds = CloudSet.from_clouds([square(0.0)] * 20)
    found = edge_distances(saved(clouds, tmp_path), pairs, identities(20), Inline())
    np.testing.assert_allclose(found, 0, atol=1e-9)


def kitchen_clouds(folder: Path, frames: range) -> tuple[CloudSet, Floats]:
    """Clouds as `method` has them (every second pixel, 0.2–6 m, 3 cm voxels, 10 neighbours), by small_gicp alone."""
    import cv2
    import small_gicp

    clouds, poses = [], []
    v, u = np.mgrid[0:480:2, 0:640:2]
    for frame in frames:
        raw = cv2.imread(str(folder / f"frame-{frame:06d}.depth.png"), cv2.IMREAD_UNCHANGED)[::2, ::2]
        z = np.where(raw == 65535, 0, raw) / 1000
        points = np.stack([(u - 320) / 585 * z, (v - 240) / 585 * z, z], axis=-1)[(z >= 0.2) & (z <= 6)]
        sampled = small_gicp.voxelgrid_sampling(small_gicp.PointCloud(points), 0.03)
        small_gicp.estimate_normals(sampled, num_neighbors=10)
        clouds.append(PointCloud(*(a[:, :3].astype(np.float32) for a in (sampled.points(), sampled.normals()))))
        pose = np.loadtxt(folder / f"frame-{frame:06d}.pose.txt")
        poses.append(se3.from_parts(se3.project_to_so3(pose[:3, :3]), pose[:3, 3]))
    return CloudSet.from_clouds(clouds), np.stack(poses)


def test_true_poses_of_red_kitchen_score_as_the_method_says(tmp_path: Path, data_dir: Path) -> None:
    clouds, truth = kitchen_clouds(data_dir / "seven_scenes/redkitchen/seq-01", range(0, 1000, 40))
    drift = np.cumsum(np.random.default_rng(0).normal(scale=[0.002] * 3 + [0.01] * 3, size=(25, 6)), axis=0)
    sets = {"truth": truth, "odometry": truth @ se3.exp(drift)}
    for graph in score_table(saved(clouds, tmp_path), sets, "truth", Inline()).graphs:
        assert len(graph.pairs) >= 5
        assert 0.83 < graph.mean_score[0] < 0.89
        assert graph.mean_score[1] < graph.mean_score[0] - 0.05


def test_residuals_vanish_at_the_poses_and_measure_what_is_left() -> None:
    rng = np.random.default_rng(3)
    poses = se3.exp(rng.normal(size=(6, 6)))
    edges: Ints = np.array([(0, 1), (2, 1), (3, 5), (0, 4)])
    exact = se3.inverse(poses[edges[:, 0]]) @ poses[edges[:, 1]]
    off = se3.exp(np.array([0.0, 0.0, 0.2, 0.0, 0.0, 0.0]))
    off[:3, 3] = 0.03, 0.04, 0.0
    measured = exact @ se3.inverse(off)
    np.testing.assert_allclose(edge_residuals(ViewGraph.from_edges(np.arange(6), edges, exact), poses), 0, atol=1e-7)
    poses[4] = np.nan
    translation_m, angle_rad = edge_residuals(ViewGraph.from_edges(np.arange(6), edges, measured), poses)
    np.testing.assert_allclose(translation_m, [0.05, 0.05, 0.05, np.nan])
    np.testing.assert_allclose(angle_rad, [0.2, 0.2, 0.2, np.nan])


def test_a_scene_eight_times_as_large_has_the_same_scores_in_another_unit(tmp_path: Path) -> None:
    squares = [square(0.0), square(0.03), square(0.0), square(0.5, 0.1)]
    large = [PointCloud(8 * one.points_in_cam, one.normals_in_cam) for one in squares]
    for name in ("small", "large"):
        (tmp_path / name).mkdir()
    small = saved(CloudSet.from_clouds(squares), tmp_path / "small")
    one = score_table(small, {"result": identities(4)}, "result", Inline())
    other = score_table(
        saved(CloudSet.from_clouds(large), tmp_path / "large"), {"result": identities(4)}, "result", Inline(), scale=8.0
    )
    assert other.scale == 8.0
    for graph, scaled in zip(one.graphs, other.graphs, strict=True):
        assert len(graph.pairs)
        np.testing.assert_array_equal(scaled.pairs, graph.pairs)
        np.testing.assert_allclose(scaled.distances_m, 8 * graph.distances_m, rtol=1e-6)
        np.testing.assert_allclose(scaled.scores, graph.scores, rtol=1e-6)
    there = edge_distances(tmp_path / "large", np.array([(0, 3)]), identities(4), Inline(), scale=8.0)
    np.testing.assert_allclose(there, [8 * NO_NEIGHBOUR_M])
