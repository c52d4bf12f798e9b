"""SIFT edges: matching and verification on made images, similarity, frames without landmarks, real frames."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest

from hodge_adapters.seven_scenes.reader import SevenScenesReader
from hodge_pipeline.errors import SourceError
from hodge_pipeline.pairs.sift import SiftEdges, count_inliers
from hodge_pipeline.pairs.vlad import most_similar
from hodge_pipeline.registration.clouds import CloudOptions, make_cloud
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


def frames_of(views: list[tuple[int, int]]) -> list[Frame]:
    flat = partial(np.full, (150, 200), 2.0, np.float32)
    return [Frame(k, float(k), CAMERA, flat, partial(part, *view)) for k, view in enumerate(views)]


def clouds_of(frames: list[Frame], landmarks: int = 400) -> CloudSet:
    options = CloudOptions(stride=8, landmarks=landmarks)
    return CloudSet.from_clouds([make_cloud(frame, options)[0] for frame in frames])


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
    first, second = first.astype(np.float32), second.astype(np.float32)
    found = count_inliers(first, second, 1 / 180)
    assert 80 <= found <= 90 and found == count_inliers(first, second, 1 / 180)
    assert count_inliers(first[:5], second[:5], 1 / 180) == 0


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
    frames = frames_of([(0, 0), (0, 15), (1, 0), (1, 15), (0, 30), (1, 30)])
    clouds, builder = clouds_of(frames), SiftEdges(min_inliers=30, reach=1, similar_per_frame=4)
    found = builder.propose(frames, clouds, poses_of(6))
    assert builder.propose(frames, clouds, poses_of(6)) is found  # the next outer iteration asks again
    wall = np.array([0, 0, 1, 1, 0, 1])
    assert (wall[found.pairs[:, 0]] == wall[found.pairs[:, 1]]).all()
    assert {(0, 1), (2, 3), (0, 4), (3, 5)} <= set(map(tuple, found.pairs.tolist()))
    assert ((found.overlap > 0) & (found.overlap <= 1)).all()
    assert set(found.proposed_by) == {"sift"}


def test_frames_without_points_or_landmarks_have_no_pair() -> None:
    frames = frames_of([(0, 0), (0, 10), (0, 20), (0, 30), (0, 40)])
    clouds = list(clouds_of(frames))
    clouds[1] = PointCloud(np.zeros((0, 3), np.float32), landmarks=clouds[1].landmarks)
    clouds[3] = replace(clouds[3], landmarks=None)
    found = SiftEdges(min_inliers=20).propose(frames, CloudSet.from_clouds(clouds), poses_of(5))
    assert len(found.pairs) and not np.isin(found.pairs, (1, 3)).any()


def test_no_landmark_at_all_is_an_error_that_names_the_option() -> None:
    frames = frames_of([(0, 0), (0, 10), (0, 20)])
    with pytest.raises(SourceError, match="clouds.landmarks"):
        SiftEdges().propose(frames, clouds_of(frames, landmarks=0), poses_of(3))


def test_too_few_frames_give_no_pairs() -> None:
    one = frames_of([(0, 0)])
    assert len(SiftEdges().propose(one, clouds_of(one), poses_of(1)).pairs) == 0
    assert len(SiftEdges().propose([], CloudSet.from_clouds([]), poses_of(0)).pairs) == 0


def test_neighbouring_real_frames_are_joined(data_dir: Path) -> None:
    folder = data_dir / "seven_scenes" / "redkitchen"
    if not folder.is_dir():
        pytest.skip(f"no red kitchen at {folder}")
    frames = [*SevenScenesReader().open(folder).frames[:3], SevenScenesReader().open(folder).frames[120]]
    found = SiftEdges(reach=3).propose(frames, clouds_of(frames, landmarks=1000), poses_of(4))
    assert set(map(tuple, found.pairs.tolist())) >= {(0, 1), (1, 2)}
    assert (2, 3) not in set(map(tuple, found.pairs.tolist()))
