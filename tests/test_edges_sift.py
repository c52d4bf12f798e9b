"""SIFT edges: matching and verification on made images, similarity, unreadable images, real frames."""

from __future__ import annotations

import logging
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest

from hodge_adapters.seven_scenes.reader import SevenScenesReader
from hodge_pipeline.errors import SourceError
from hodge_pipeline.pairs.sift import Features, SiftEdges
from hodge_pipeline.pairs.sift_matching import count_inliers
from hodge_pipeline.pairs.sift_similarity import most_similar
from hodge_pipeline.registration.descriptors import match
from hodge_pipeline.types import Bytes, Camera, CloudSet, Floats, Frame, PointCloud

CAMERA = Camera(200, 150, 180.0, 180.0, 99.5, 74.5)


def texture(seed: int) -> Bytes:
    """A wall full of blobs, 400 x 300."""
    noise = np.random.default_rng(seed).random((75, 100, 3)).astype(np.float32)
    return np.clip(cv2.resize(noise, (400, 300), interpolation=cv2.INTER_CUBIC) * 255, 0, 255).astype(np.uint8)


def part(seed: int, left: int) -> Bytes:
    """What a camera sees of the wall from `left` pixels along it."""
    return texture(seed)[70:220, left : left + 200]


def unreadable() -> Bytes:
    raise SourceError("frame-000003.color.png: truncated")


def frames_of(views: list[tuple[int, int]]) -> list[Frame]:
    return [Frame(k, float(k), CAMERA, read_colour=partial(part, *view)) for k, view in enumerate(views)]


def clouds_of(count: int) -> CloudSet:
    return CloudSet.from_clouds([PointCloud(np.ones((3, 3), np.float32))] * count)


def poses_of(count: int) -> Floats:
    return np.broadcast_to(np.eye(4), (count, 4, 4))


def test_matches_are_mutual_and_clearly_the_nearest() -> None:
    basis = np.eye(128, dtype=np.float32)
    # row 0 finds its like; rows 1 and 2 are both like target 1, so that the ratio refuses the nearest of them
    first = np.stack([basis[0], basis[1], basis[2]])
    second = np.stack([basis[2], basis[0], (basis[1] + basis[3]) / np.sqrt(2), (basis[1] + basis[4]) / np.sqrt(2)])
    np.testing.assert_array_equal(match(first, second, 0.8), [[0, 1], [2, 0]])
    assert len(match(first[:1], second, 0.8)) == 0


def test_inliers_are_those_that_one_motion_explains() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform([-1, -1, 2], [1, 1, 4], (120, 3))
    turn, _ = cv2.Rodrigues(np.array([0.02, 0.1, -0.03]))
    moved = points @ turn.T + [0.3, 0.05, 0.1]
    first, second = (p[:, :2] / p[:, 2:] for p in (points, moved))
    second[80:] = rng.uniform(-0.4, 0.4, (40, 2))
    cameras = (CAMERA, CAMERA)
    found = count_inliers(first.astype(np.float32), second.astype(np.float32), cameras)
    assert 80 <= found <= 90
    assert found == count_inliers(first.astype(np.float32), second.astype(np.float32), cameras)
    pixels = [(p * 180 + [99.5, 74.5]).astype(np.float32) for p in (first, second)]
    assert 75 <= count_inliers(*pixels, (None, None)) <= 95
    assert count_inliers(pixels[0][:5], pixels[1][:5], (None, None)) == 0


def test_similar_frames_are_spread_over_the_sequence() -> None:
    # frames 0 to 2 and 10 to 12 look alike, the others like nothing
    vectors = np.eye(13, dtype=np.float32)
    vectors[[1, 2, 10, 11, 12]] = vectors[0]
    pairs = most_similar(vectors, 1, 3)
    assert [0, 10] in pairs.tolist() or [0, 9] in pairs.tolist() or [0, 11] in pairs.tolist()
    assert (pairs[:, 1] - pairs[:, 0] > 3).all()
    assert (pairs[:, 0] < pairs[:, 1]).all()
    assert len(most_similar(vectors[:3], 5, 3)) == 0


def test_frames_of_one_wall_are_joined_and_those_of_two_walls_are_not() -> None:
    views = [(0, 0), (0, 15), (1, 0), (1, 15), (0, 30), (1, 30)]
    solver = SiftEdges(min_inliers=30, reach=1, similar_per_frame=4, max_features=400, words=4)
    found = solver.propose(frames_of(views), clouds_of(6), poses_of(6))
    wall = np.array([view[0] for view in views])
    assert (wall[found.pairs[:, 0]] == wall[found.pairs[:, 1]]).all()
    assert {(0, 1), (2, 3), (0, 4), (3, 5)} <= set(map(tuple, found.pairs.tolist()))
    assert ((found.overlap > 0) & (found.overlap <= 1)).all()
    assert set(found.proposed_by) == {"sift"}


def test_the_same_frames_are_matched_once_and_the_same_again() -> None:
    frames = frames_of([(0, 0), (0, 10), (0, 20)])
    options = SiftEdges(min_inliers=20, max_features=300, words=2)
    first = options.propose(frames, clouds_of(3), poses_of(3))
    assert options.propose(frames, clouds_of(3), poses_of(3)) is first
    again = SiftEdges(min_inliers=20, max_features=300, words=2, ratio=0.80001).propose(
        frames, clouds_of(3), poses_of(3)
    )
    np.testing.assert_array_equal(again.pairs, first.pairs)


def test_unreadable_images_are_reported_and_empty_frames_left_out(caplog: pytest.LogCaptureFixture) -> None:
    frames = frames_of([(0, 0), (0, 10), (0, 20), (0, 30), (0, 40)])
    frames[3] = replace(frames[3], read_colour=unreadable)
    clouds = [PointCloud(np.ones((3 if k != 1 else 0, 3), np.float32)) for k in range(5)]
    with caplog.at_level(logging.WARNING, logger="hodge_pipeline"):
        found = SiftEdges(min_inliers=20, max_features=300).propose(frames, CloudSet.from_clouds(clouds), poses_of(5))
    assert not np.isin(found.pairs, (1, 3)).any()
    assert len(found.pairs)
    assert "frame 3: no SIFT edges: frame-000003.color.png: truncated" in caplog.text


def test_no_usable_image_is_an_error_that_names_a_remedy() -> None:
    frames = [Frame(k, float(k), CAMERA) for k in range(3)]
    with pytest.raises(SourceError, match="centroid or overlap"):
        SiftEdges().propose(frames, clouds_of(3), poses_of(3))
    blank = [Frame(k, float(k), CAMERA, read_colour=partial(np.full, (20, 20, 3), 7, np.uint8)) for k in range(3)]
    with pytest.raises(SourceError, match="no SIFT feature"):
        SiftEdges().propose(blank, clouds_of(3), poses_of(3))


def test_too_few_frames_give_no_pairs() -> None:
    assert len(SiftEdges().propose(frames_of([(0, 0)]), clouds_of(1), poses_of(1)).pairs) == 0
    assert len(SiftEdges().propose([], CloudSet.from_clouds([]), poses_of(0)).pairs) == 0


def test_features_live_on_disk_and_are_unit_vectors() -> None:
    features = Features(frames_of([(0, 0), (0, 50)]), np.array([0, 1]), 200)
    for row in (0, 1):
        assert 50 < features.count(row) <= 200
        norms = np.linalg.norm(features.descriptors(row), axis=1)
        np.testing.assert_allclose(norms, 1.0, atol=1e-5)
        assert np.abs(features.points(row)).max() < 0.6  # slopes of rays, not pixels
    features.close()


def test_neighbouring_real_frames_are_joined(data_dir: Path) -> None:
    folder = data_dir / "seven_scenes" / "redkitchen"
    if not folder.is_dir():
        pytest.skip(f"no red kitchen at {folder}")
    frames = [*SevenScenesReader().open(folder).frames[:3], SevenScenesReader().open(folder).frames[120]]
    found = SiftEdges(reach=3).propose(frames, clouds_of(4), poses_of(4))
    assert set(map(tuple, found.pairs.tolist())) >= {(0, 1), (1, 2)}
    assert (2, 3) not in set(map(tuple, found.pairs.tolist()))
