"""Pairs that slid along a bare surface are refuted by free space, and are neither edges nor steps of odometry."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from hodge_pipeline import se3
from hodge_pipeline.executors.local import LocalExecutor
from hodge_pipeline.recipe.schema import load_recipe
from hodge_pipeline.refine.model_edges import depth_edges
from hodge_pipeline.registration.acceptance import SEEN_THROUGH, Acceptance, accepted, with_odometry
from hodge_pipeline.registration.assessment import MOST_VIOLATION
from hodge_pipeline.registration.clouds import CloudOptions, make_cloud
from hodge_pipeline.registration.gicp import Gicp
from hodge_pipeline.registration.odometry import OdometryOptions, odometry
from hodge_pipeline.registration.register import register_edges
from hodge_pipeline.registration.seen_through import with_seen_through
from hodge_pipeline.review.adding import Candidate, assessed
from hodge_pipeline.stages import Step
from hodge_pipeline.types import Camera, CloudSet, Edges, Frame, PointCloud, Registration, ViewGraph

CAMERA = Camera(640, 480, 525.0, 525.0, 319.5, 239.5)
PAIRS = [[0, 1], [0, 2], [1, 2]]
SLID = np.array([0.0, 0.6, 0.0])
"""Metres along the wall by which each pair is off."""


@pytest.fixture(scope="module")
def clouds() -> CloudSet:
    """A bare wall at 2 m with a post a metre before it, seen three times from one place."""
    u, v = np.meshgrid(np.arange(-1.2, 1.2, 0.03), np.arange(-0.9, 0.9, 0.03))
    wall = np.stack([u, v, np.full_like(u, 2.0)], axis=-1).reshape(-1, 3)
    post = wall[np.abs(wall[:, 0]) < 0.3] * [1.0, 0.5, 0.5]
    behind = np.abs(wall[:, 0]) < 0.6
    points = np.concatenate([wall[~behind], post]).astype(np.float32)
    return CloudSet.from_clouds([PointCloud(points, depth_camera=CAMERA)] * 3)


@pytest.fixture(scope="module")
def found() -> Edges:
    motions = se3.exp(np.concatenate([np.zeros((3, 3)), SLID[:, None] * [1, 0, 0]], axis=1))
    return Edges.of(PAIRS).with_registrations([Registration(m, np.eye(6), 0.7, 0.01, 900, 5, True) for m in motions])


@pytest.fixture(scope="module")
def registered(clouds: CloudSet, found: Edges) -> Edges:
    return with_seen_through(found, clouds)


def test_what_slid_before_what_the_other_saw_through_is_no_edge(clouds: CloudSet, registered: Edges) -> None:
    through = registered.seen_through
    assert through[0] == through[2] == 0 and through[1] > MOST_VIOLATION
    assert Acceptance(min_spread=0).reasons(registered).tolist() == ["", SEEN_THROUGH, ""]
    assert set(Acceptance(min_spread=0, max_seen_through=None).reasons(registered)) == {""}
    with_scan = CloudSet.from_clouds([clouds[0], replace(clouds[1], depth_camera=None), clouds[2]])
    assert np.isnan(with_seen_through(registered, with_scan).seen_through).tolist() == [True, False, True]
    by_landmarks = registered.put(1, by_landmarks=True)
    assert np.isnan(with_seen_through(by_landmarks, clouds).seen_through).tolist() == [False, True, False]


def test_the_unit_of_length_does_not_matter(clouds: CloudSet, registered: Edges) -> None:
    large = CloudSet.from_clouds([PointCloud(100 * cloud.points_in_cam, depth_camera=CAMERA) for cloud in clouds])
    motions = registered.i_from_j.copy()
    motions[:, :3, 3] *= 100
    found = with_seen_through(registered.put(slice(None), i_from_j=motions), large, scale=100.0)
    np.testing.assert_allclose(found.seen_through, registered.seen_through, atol=1e-6)


def test_of_each_cloud_its_view_and_a_thousand_points_are_kept() -> None:
    count = 30
    wall = np.random.default_rng(0).uniform(-1, 1, (20000, 3)).astype(np.float32) * [1.0, 1.0, 0.0] + [0, 0, 2]
    large = CloudSet.from_clouds([PointCloud(wall.astype(np.float32), depth_camera=CAMERA)] * count)
    pairs = Edges.of([(row, row + 1) for row in range(count - 1)])
    pairs = pairs.with_registrations([Registration(np.eye(4), np.eye(6), 0.7, 0.01, 900, 5, True)] * len(pairs))
    tracemalloc.start()
    try:
        with_seen_through(pairs, large)
        peak_bytes = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert (
        peak_bytes < 50_000 * count + 3_000_000
    )  # of which one cloud at work takes 2 MB; whole clouds would take 14 MB


def test_a_step_that_a_round_slides_keeps_the_measurement_of_odometry(registered: Edges) -> None:
    judged, _ = accepted(registered, Acceptance(min_spread=0), None)
    assert judged.why.tolist() == ["", SEEN_THROUGH, ""]
    step = registered.select(np.array([1])).put(slice(None), proposed_by="sequential", i_from_j=np.eye(4), fitness=0.4)
    kept = with_odometry(judged, step)
    assert kept.counts.all() and np.array_equal(kept.i_from_j[1], np.eye(4))
    assert accepted(registered, Acceptance(min_spread=0, max_seen_through=None), None)[0].counts.all()


@pytest.mark.parametrize("limit", [MOST_VIOLATION, None])
def test_odometry_is_lost_at_a_step_that_free_space_refutes(
    clouds: CloudSet, limit: float | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clouds.save(tmp_path)
    shares = np.array([0.0, 0.4])
    tested: Any = lambda steps, *_: replace(steps, seen_through=shares)  # noqa: E731
    monkeypatch.setattr("hodge_pipeline.registration.odometry.with_seen_through", tested)
    with LocalExecutor(workers=0).open() as workers:
        options = OdometryOptions(max_seen_through=limit)
        found = odometry(tmp_path, [np.arange(3)], np.arange(3.0), options, workers)
    assert found.steps.pairs.tolist() == ([[0, 1]] if limit else [[0, 1], [1, 2]])
    assert len(found.notes) == (limit is not None)
    assert all("rows 1 and 2 (surfaces fit" in note for note in found.notes)


def test_the_step_of_registration_tells_what_was_seen_through_and_measures_it_once(
    clouds: CloudSet, tmp_path: Path
) -> None:
    clouds.save(tmp_path / "clouds")
    poses = np.tile(np.eye(4), (3, 1, 1))
    with LocalExecutor(workers=0).open() as workers:
        step, stored = Step(tmp_path, lambda _: None, lambda *_: None), CloudSet.open(tmp_path / "clouds")
        found = register_edges(Edges.of(PAIRS), stored, Gicp(), poses, workers=workers, step=step)
        marked = found.put([0, 2], seen_through=[0.5, np.nan])
        kept = register_edges(Edges.of(PAIRS), stored, Gicp(), poses, marked, workers=workers, step=step)
    assert found.seen_through.tolist() == [0.0] * 3
    assert kept.seen_through.tolist() == [0.5, 0.0, 0.0]


def test_a_cloud_of_a_depth_image_knows_its_camera_and_one_of_a_scan_has_none(tmp_path: Path) -> None:
    depth = np.full((480, 640), 2.0, np.float32)
    of_depth = Frame(0, 0.0, CAMERA, read_depth=lambda: depth)
    of_scan = Frame(1, 1.0, CAMERA, read_points=lambda: PointCloud(np.ones((20, 3), np.float32)))
    made = CloudSet.from_clouds([make_cloud(frame, CloudOptions())[0] for frame in (of_depth, of_scan)])
    made.save(tmp_path)
    assert [cloud.depth_camera for cloud in CloudSet.open(tmp_path)] == [CAMERA, None]


def test_review_says_of_a_pair_added_by_hand_what_the_solve_will(clouds: CloudSet) -> None:
    recipe, slid = load_recipe("seven_scenes"), se3.exp(np.array([0, 0, 0, SLID[1], 0, 0]))
    graph = ViewGraph.from_edges(np.arange(3), np.zeros((0, 2), np.int64), np.zeros((0, 4, 4)))
    poses = np.tile(np.eye(4), (3, 1, 1))
    for motion, why in ((slid, SEEN_THROUGH), (np.eye(4), "")):
        found = Registration(motion, np.eye(6), 0.7, 0.01, 900, 5, True)
        assert assessed(recipe, graph, clouds, poses, Candidate(0, 2, motion), found).rejected == why


def test_depth_beside_a_model_is_tested_by_free_space_too(clouds: CloudSet, registered: Edges) -> None:
    results = iter([(clouds, ()), registered])
    steps: Any = SimpleNamespace(step=lambda *_, **__: next(results), remember=lambda *_: None, key=lambda _: "")
    eye, rows = np.eye(4), range(3)
    frames = [Frame(row, float(row), CAMERA, read_depth=lambda: np.zeros((1, 1)), world_from_cam=eye) for row in rows]
    model: Any = SimpleNamespace(
        frames=frames, body_of_frame=np.arange(3), body_from_cam=np.tile(eye, (3, 1, 1)), body_names=tuple("abc")
    )
    options: Any = SimpleNamespace(
        edges=SimpleNamespace(propose=lambda *_: Edges.of(PAIRS)),
        clouds=None,
        registration=None,
        seed=0,
        acceptance=Acceptance(min_spread=0.0),
    )
    found = depth_edges(model, options, steps, SimpleNamespace())
    assert found.graph.edges.tolist() == [PAIRS[0], PAIRS[2]]
    assert found.notes == (f"1 pair with depth left out: {SEEN_THROUGH}",)
