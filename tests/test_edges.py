"""Edge builders: hand answers on little clouds, laws, and real frames."""

from __future__ import annotations

import dataclasses
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from hodge_adapters.seven_scenes.reader import SevenScenesReader
from hodge_pipeline import se3
from hodge_pipeline.errors import GraphError
from hodge_pipeline.pairs.candidates import merge
from hodge_pipeline.pairs.centroid import CentroidEdges
from hodge_pipeline.pairs.combined import CombinedEdges
from hodge_pipeline.pairs.overlap import FRAMES_OF_A_PLACE, OverlapEdges, pairwise_iou, some_of_each_place
from hodge_pipeline.pairs.sequential import SequentialEdges
from hodge_pipeline.types import CloudSet, Edges, Frame, PointCloud


def frames_of(*sequences: str) -> list[Frame]:
    return [Frame(row, float(row), sequence=name) for row, name in enumerate(sequences)]


def clouds_of(*points: object) -> CloudSet:
    return CloudSet.from_clouds([PointCloud(np.array(p, np.float32).reshape(-1, 3)) for p in points])


def poses_at(*x: float) -> np.ndarray:
    poses = np.tile(np.eye(4), (len(x), 1, 1))
    poses[:, 0, 3] = x
    return poses


POINT = [[0.05, 0.05, 0.05]]


def as_list(candidates: Edges) -> list[tuple[int, int]]:
    return [(int(i), int(j)) for i, j in candidates.pairs]


def test_sequential_bridges_empty_clouds_and_stays_in_its_sequence() -> None:
    # rows     0    1      2    3    4    5      a: 0 - 2 - 4     b: 1 - 5  (3 is empty)
    clouds = clouds_of(POINT, POINT, POINT, [], POINT, POINT)
    frames = frames_of("a", "b", "a", "a", "a", "b")
    one = SequentialEdges().propose(frames, clouds, poses_at(*[0] * 6))
    assert as_list(one) == [(0, 2), (1, 5), (2, 4)]
    assert set(one.proposed_by) == {"sequential"} and np.isnan(one.overlap).all()
    assert as_list(SequentialEdges(reach=9).propose(frames, clouds, poses_at(*[0] * 6))) == [
        (0, 2),
        (0, 4),
        (1, 5),
        (2, 4),
    ]


def test_sequential_needs_no_pose() -> None:
    poses = poses_at(np.nan, 0, np.nan)
    assert as_list(SequentialEdges().propose(frames_of(*"aaa"), clouds_of(POINT, POINT, POINT), poses)) == [
        (0, 1),
        (1, 2),
    ]


def test_centroids_are_compared_in_the_world() -> None:
    # both clouds of a pair have their centroid at x + 1, so the distances are those of the poses
    clouds = clouds_of(*[[[0, 0, 0], [2, 0, 0]]] * 4, [])
    poses = poses_at(0, 0.15, 0.3, 5, 0)
    found = CentroidEdges(max_distance_m=0.2).propose(frames_of(*"aaaaa"), clouds, poses)
    assert as_list(found) == [(0, 1), (1, 2)]
    turned = poses.copy()
    turned[1, :3, :3] = np.diag([-1, -1, 1])  # its centroid goes to −0.85
    assert as_list(CentroidEdges(max_distance_m=0.2).propose(frames_of(*"aaaaa"), clouds, turned)) == []


def test_iou_of_a_hand_made_pair() -> None:
    # voxels of 1 m along x:  frame 0 has 0 1 2, frame 1 has 2 3: one shared of four
    clouds = clouds_of([[0.5, 0, 0], [1.5, 0, 0], [2.5, 0, 0], [2.6, 0, 0]], [[0.5, 0, 0], [1.5, 0, 0]], [])
    iou = pairwise_iou(clouds, poses_at(0, 2, 0), 1.0)
    assert iou.toarray() == pytest.approx(np.array([[0, 0.25, 0], [0, 0, 0], [0, 0, 0]]))
    assert pairwise_iou(clouds, poses_at(0, 2, 0), 1.0, above=0.25).nnz == 0


@given(seed=st.integers(0, 999), count=st.integers(0, 6))
@settings(max_examples=25, deadline=None)
def test_iou_equals_that_of_python_sets(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    clouds = [PointCloud(rng.uniform(-1, 1, (rng.integers(0, 40), 3)).astype(np.float32)) for _ in range(count)]
    poses = poses_at(*rng.uniform(-1e3, 1e3, 1).repeat(count) + rng.uniform(-0.5, 0.5, count))
    sets = []
    for cloud, pose in zip(clouds, poses, strict=True):
        world = cloud.points_in_cam.astype(float) + pose[:3, 3]
        sets.append({tuple(cell) for cell in np.floor(world / 0.3).astype(int)})
    iou = pairwise_iou(clouds, poses, 0.3).toarray()
    partners = np.flatnonzero(rng.integers(0, 2, count))
    of_partners = pairwise_iou(clouds, poses, 0.3, partners=partners).toarray()
    for i in range(count):
        for j in range(count):
            union = len(sets[i] | sets[j])
            expected = len(sets[i] & sets[j]) / union if i < j and union else 0.0
            assert iou[i, j] == pytest.approx(expected)
            assert of_partners[i, j] == pytest.approx(expected if {i, j} & set(partners.tolist()) else 0.0)


def test_iou_in_many_blocks_is_that_of_one(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(3)
    clouds = [PointCloud(rng.uniform(0, 1, (30, 3)).astype(np.float32)) for _ in range(9)]
    whole = pairwise_iou(clouds, poses_at(*[0.0] * 9), 0.2)
    monkeypatch.setattr("hodge_pipeline.pairs.candidates.BLOCK_ENTRIES", 18)
    assert whole.nnz == 36
    assert (pairwise_iou(clouds, poses_at(*[0.0] * 9), 0.2) != whole).nnz == 0


def test_frames_without_a_finite_pose_get_no_overlap() -> None:
    clouds, poses = clouds_of(POINT, POINT, POINT), poses_at(0, np.nan, 0)
    assert as_list(OverlapEdges().propose(frames_of(*"aaa"), clouds, poses)) == [(0, 2)]
    assert as_list(CentroidEdges().propose(frames_of(*"aaa"), clouds, poses)) == [(0, 2)]


def test_overlap_far_from_the_origin_works_and_diverged_poses_are_named() -> None:
    utm = poses_at(5e6, 5e6)
    assert as_list(OverlapEdges().propose(frames_of(*"aa"), clouds_of(POINT, POINT), utm)) == [(0, 1)]
    with pytest.raises(GraphError, match="diverged"):
        OverlapEdges().propose(frames_of(*"aa"), clouds_of(POINT, POINT), poses_at(0, 5e6))


LINE = poses_at(0, 0.1, 0.2, 3.0, 0.0)
LINE_FRAMES = frames_of(*"aaaaa")
LINE_CLOUDS = clouds_of(*[POINT] * 5)


def test_combined_joins_reasons() -> None:
    builders = (SequentialEdges(), OverlapEdges(voxel_m=0.15), CentroidEdges(max_distance_m=0.11))
    found = CombinedEdges(builders=builders).propose(LINE_FRAMES, LINE_CLOUDS, LINE)
    assert dict(zip(as_list(found), found.proposed_by.tolist(), strict=True)) == {
        (0, 1): "sequential+centroid",
        (0, 4): "overlap+centroid",
        (1, 2): "sequential+overlap+centroid",
        (1, 4): "centroid",
        (2, 3): "sequential",
        (3, 4): "sequential",
    }
    assert found.overlap.tolist() == pytest.approx([np.nan, 1, 1, np.nan, np.nan, np.nan], nan_ok=True)


def test_combined_all_keeps_what_every_builder_agrees_on_and_the_sequence() -> None:
    builders = (SequentialEdges(), OverlapEdges(voxel_m=0.15), CentroidEdges(max_distance_m=0.11))
    found = CombinedEdges(builders=builders, mode="all").propose(LINE_FRAMES, LINE_CLOUDS, LINE)
    assert as_list(found) == [(0, 1), (0, 4), (1, 2), (2, 3), (3, 4)]
    alone = CombinedEdges(builders=builders[:1], mode="all").propose(LINE_FRAMES, LINE_CLOUDS, LINE)
    assert as_list(alone) == [(0, 1), (1, 2), (2, 3), (3, 4)]


def test_combined_nests_and_rejects_what_is_no_builder() -> None:
    inner = CombinedEdges(builders=(SequentialEdges(), CentroidEdges(max_distance_m=0.11)))
    flat = CombinedEdges(builders=(*inner.builders, OverlapEdges()))
    nested = CombinedEdges(builders=(inner, OverlapEdges()))
    for a, b in zip(
        dataclasses.astuple(flat.propose(LINE_FRAMES, LINE_CLOUDS, LINE)),
        dataclasses.astuple(nested.propose(LINE_FRAMES, LINE_CLOUDS, LINE)),
        strict=True,
    ):
        np.testing.assert_array_equal(a, b)
    with pytest.raises(ValidationError, match="EdgeBuilder"):
        CombinedEdges(builders=("overlap",))  # type: ignore[arg-type]
    with pytest.raises(ValidationError, match="at least 1"):
        CombinedEdges(builders=())


def test_merge_of_a_union_keeps_the_best_overlap() -> None:
    a = Edges.proposed(np.array([[0, 1], [0, 2]]), "x", np.array([0.2, np.nan]))
    b = replace(Edges.of([[0, 1], [1, 2]], np.array(["y", "x"])), overlap=np.array([0.7, 0.1]))
    merged, votes = merge([a, b])
    assert as_list(merged) == [(0, 1), (0, 2), (1, 2)]
    assert merged.proposed_by.tolist() == ["x+y", "x", "x"]
    assert merged.overlap.tolist() == pytest.approx([0.7, np.nan, 0.1], nan_ok=True)
    assert votes.tolist() == [[True, True], [True, False], [False, True]]


def test_red_kitchen_pairs(data_dir) -> None:  # type: ignore[no-untyped-def]
    """Every tenth frame under the reference poses, against the sets of their voxels."""
    reader = SevenScenesReader()
    folder = data_dir / "seven_scenes" / "redkitchen"
    if not folder.is_dir():
        pytest.skip(f"{folder} is absent")
    frames = [frame for frame in reader.open(folder).frames][::10]
    clouds = CloudSet.from_clouds([PointCloud(sparse_points(frame)) for frame in frames])
    poses = np.array([frame.world_from_cam for frame in frames])
    found = OverlapEdges(min_iou=0.3).propose(frames, clouds, poses)
    sets = [
        {tuple(cell) for cell in np.floor(se3.transform(pose, cloud.points_in_cam) / 0.1).astype(int)}
        for pose, cloud in zip(poses, clouds, strict=True)
    ]
    iou = {(i, j): len(sets[i] & sets[j]) / len(sets[i] | sets[j]) for j in range(len(sets)) for i in range(j)}
    expected = {pair: value for pair, value in sorted(iou.items()) if value > 0.3}
    assert len(expected) > 20
    assert as_list(found) == list(expected)
    assert found.overlap == pytest.approx(list(expected.values()))


def sparse_points(frame: Frame) -> np.ndarray:
    """Every fourth pixel of a depth image as points in the camera's axes."""
    assert frame.camera is not None and frame.read_depth is not None
    depth = frame.read_depth()[::4, ::4]
    v, u = np.nonzero((depth > 0.2) & (depth < 6))
    z = depth[v, u]
    x = (4 * u - frame.camera.cx) / frame.camera.fx * z
    y = (4 * v - frame.camera.cy) / frame.camera.fy * z
    return np.stack([x, y, z], axis=1).astype(np.float32)


def test_pairs_grow_with_the_frames_however_often_a_camera_comes_back() -> None:
    counts = {}
    for laps in (4, 40, 80):
        poses = poses_at(*[0.0, 1.0] * laps)
        clouds = clouds_of(*[POINT] * len(poses))
        pairs = OverlapEdges(min_iou=0.5).propose(frames_of(*[""] * len(poses)), clouds, poses).pairs
        assert (pairs[:, 0] < pairs[:, 1]).all() and len(np.unique(pairs, axis=0)) == len(pairs)
        assert ((pairs[:, 0] - pairs[:, 1]) % 2 == 0).all(), "of the same place"
        assert len(np.unique(pairs)) == len(poses), "every frame has a partner"
        counts[laps] = len(pairs)
    assert counts[4] == 2 * 4 * 3 // 2, "all pairs, of few"
    assert counts[80] - counts[40] == 2 * 40 * FRAMES_OF_A_PLACE


@given(st.lists(st.integers(0, 3), max_size=80))
def test_of_each_place_some_frames_are_taken_evenly(places: list[int]) -> None:
    rows = some_of_each_place(poses_at(*map(float, places)), 0.2)
    assert (np.diff(rows) > 0).all()
    for place in set(places):
        own = np.flatnonzero(np.array(places) == place)
        taken = np.searchsorted(own, rows[np.isin(rows, own)])
        assert len(taken) == min(len(own), FRAMES_OF_A_PLACE) and taken[0] == 0
        assert np.ptp(np.diff(taken)) <= 1 if len(taken) > 1 else True


def test_frames_that_look_elsewhere_are_of_another_place() -> None:
    poses = se3.exp(np.array([[0, angle, 0, 0, 0, 0] for angle in np.linspace(0, 2 * np.pi, 64, endpoint=False)]))
    assert len(some_of_each_place(poses, 0.2)) == 64
