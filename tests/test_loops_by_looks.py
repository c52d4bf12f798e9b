"""Loops by what frames look like: a walk round a ring of rooms, whose odometry has drifted by metres when it closes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from hodge_pipeline import se3
from hodge_pipeline.executors.local import InProcess
from hodge_pipeline.pairs.revisits import Revisits, find_revisits
from hodge_pipeline.registration.odometry_path import drift_of
from hodge_pipeline.scene import Drift, Round
from hodge_pipeline.stages import Step, no_progress
from hodge_pipeline.start.odometry import close_loops
from hodge_pipeline.start.unordered.loops import find_loops, is_long
from hodge_pipeline.start.unordered.options import GlobalStart
from hodge_pipeline.start.unordered.start import uses_images
from hodge_pipeline.types import CloudSet, Edges, Floats, Frame, Landmarks, PointCloud, Registration, Source

RADIUS_M, STEP_M, ROUNDS = 10.0, 0.3, 1.15
SECTORS = 8
PATCHES, PATCH_M, PATCH_POINTS = 100, 0.3, 30
"""In each sector, 7.9 m of the ring; a patch is a piece of a wall with a landmark in its middle."""
SEEN_M, ANGLE_DEG = 5.0, 50.0
PART = np.zeros(int(ROUNDS * 2 * np.pi * RADIUS_M / STEP_M), np.int64)
DRIFT = np.array([0, 0.0012, 0, 0.002, 0, 0.002])
"""By which each step errs: 3.3 m in the end."""
SIGMA = np.array([0.004, 0.004, 0.006, 0.03, 0.03, 0.03])


@dataclass(frozen=True)
class Walk:
    """A walk: its clouds, true poses, odometry's steps and poses, and what these say of pairs."""

    clouds: CloudSet
    true: Floats
    steps: Edges
    first: Round
    drift: Drift
    source: Source


def placed(turn: Floats, wavy: float) -> Floats:
    """Poses (N, 4, 4) of level cameras that look along a ring, at these turns (N,) of it."""
    radius = RADIUS_M + wavy * (2 * np.cos(2 * turn) + 1.2 * np.sin(3 * turn))
    slope = wavy * (3.6 * np.cos(3 * turn) - 4 * np.sin(2 * turn))
    out, up = np.stack([np.cos(turn), np.sin(turn), 0 * turn], 1), np.array([0.0, 0.0, 1.0])
    ahead = slope[:, None] * out + radius[:, None] * np.cross(up, out)
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    down = np.broadcast_to(-up, ahead.shape)
    return se3.from_parts(np.stack([np.cross(down, ahead), down, ahead], axis=-1), radius[:, None] * out)


def ring(folder: Path, *, alike: bool) -> Walk:
    """Sectors of a wavy ring with walls of their own, or of a round one, each a copy of the first."""
    rng, wavy = np.random.default_rng(0), 0.0 if alike else 1.0
    points, normals, landmarks, descriptors = [], [], [], []
    for sector in range(SECTORS):
        made = np.random.default_rng(1 if alike else sector)
        turn = (sector + made.uniform(0, 1, PATCHES)) * 2 * np.pi / SECTORS
        aside = made.choice([-1, 1], PATCHES) * made.uniform(1.2, 2.0, PATCHES)
        middle = np.stack([aside, made.uniform(-1, 1, PATCHES), np.zeros(PATCHES)], axis=1)
        flat = made.uniform(-PATCH_M, PATCH_M, (PATCHES, PATCH_POINTS, 3)) * [1, 1, 0]
        axes = se3.exp(np.concatenate([made.normal(size=(PATCHES, 3)), np.zeros((PATCHES, 3))], axis=1))[:, :3, :3]
        walls = middle[:, None] + flat @ axes.swapaxes(1, 2)
        there = placed(turn, wavy)
        points.append((walls @ there[:, :3, :3].swapaxes(1, 2) + there[:, None, :3, 3]).reshape(-1, 3))
        normals.append(np.repeat(np.einsum("nij,nj->ni", there[:, :3, :3], axes[:, :, 2]), PATCH_POINTS, axis=0))
        landmarks.append(np.einsum("nij,nj->ni", there[:, :3, :3], middle) + there[:, :3, 3])
        descriptors.append(np.minimum(made.exponential(25, (PATCHES, 128)), 255))
    world, facing = np.concatenate(points), np.concatenate(normals)
    marks, words = np.concatenate(landmarks), np.concatenate(descriptors)
    poses = placed(np.arange(len(PART)) * STEP_M / RADIUS_M, wavy)
    clouds = []
    for pose in poses:
        near = seen(se3.transform(se3.inverse(pose), world))
        mine = se3.transform(se3.inverse(pose), marks)
        found = np.flatnonzero(seen(mine))
        noisy = np.clip(words[found] + rng.normal(0, 5, (len(found), 128)), 0, 255).astype(np.uint8)
        own = Landmarks(mine[found].astype(np.float32), noisy, np.full(len(found), 0.002, np.float32))
        cloud = se3.transform(se3.inverse(pose), world[near]) + rng.normal(0, 0.003, (near.sum(), 3))
        turned = facing[near] @ pose[:3, :3]
        clouds.append(PointCloud(cloud.astype(np.float32), turned.astype(np.float32), landmarks=own))
    folder.mkdir()
    CloudSet.from_clouds(clouds).save(folder)
    pairs = np.stack([np.arange(len(PART) - 1), np.arange(1, len(PART))], axis=1)
    motions = se3.inverse(poses[:-1]) @ poses[1:] @ se3.exp(DRIFT)
    known = [Registration(one, np.diag(SIGMA**-2), 1.0, 0.0, 100, 1, True) for one in motions]
    steps = Edges.of(pairs, "sequential").with_registrations(known)
    chained = [poses[0]]
    for motion in motions:
        chained.append(chained[-1] @ motion)
    odometry = np.array(chained)
    source = Source("ring", folder, tuple(Frame(row, row / 2) for row in range(len(PART))))
    first = Round(steps, np.arange(len(PART)), odometry)
    return Walk(CloudSet.open(folder), poses, steps, first, drift_of(odometry, steps, 0.01), source)


def seen(points_in_cam: Floats) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
    """Where (N,) points lie ahead."""
    ahead = points_in_cam[:, 2]
    far = np.linalg.norm(points_in_cam, axis=1)
    return np.asarray((far < SEEN_M) & (far > 0.3) & (ahead > far * np.cos(np.deg2rad(ANGLE_DEG))))


def error_m(walk: Walk, poses: Floats) -> float:
    """The largest error of a position, the first pose at the truth."""
    return float(np.linalg.norm(poses[:, :3, 3] - walk.true[:, :3, 3], axis=1).max())


def closed(walk: Walk, folder: Path) -> tuple[Edges, Floats]:
    """The loops by looks, and the poses with all loops closed."""
    step = Step(folder, no_progress, lambda *_: None)
    options = Revisits(), GlobalStart()
    assert is_long(walk.clouds, walk.steps, walk.drift, options[0]) and uses_images(walk.clouds, options[1])
    loops = find_loops(walk.source, walk.clouds, walk.steps, walk.drift, *options, workers=InProcess(), step=step)
    return loops, close_loops(walk.clouds, walk.first, PART, Revisits(), loops, step=step).world_from_cam


def test_a_walk_closes_that_has_drifted_farther_than_the_poses_are_searched(tmp_path: Path) -> None:
    walk = ring(tmp_path / "clouds", alike=False)
    (tmp_path / "step").mkdir()
    assert not len(find_revisits(walk.clouds, walk.first.world_from_cam, PART, Revisits()))
    loops, poses = closed(walk, tmp_path / "step")
    i, j = loops.pairs.T
    off = se3.inverse(se3.inverse(walk.true[i]) @ walk.true[j]) @ loops.i_from_j
    assert len(loops) >= 3 and np.linalg.norm(off[:, :3, 3], axis=1).max() < 0.05
    assert error_m(walk, walk.first.world_from_cam) > 3
    assert error_m(walk, poses) < 1


def test_rooms_that_are_all_alike_make_it_no_worse(tmp_path: Path) -> None:
    walk = ring(tmp_path / "clouds", alike=True)
    (tmp_path / "step").mkdir()
    _, poses = closed(walk, tmp_path / "step")
    assert error_m(walk, poses) <= 1.05 * error_m(walk, walk.first.world_from_cam)


@pytest.mark.parametrize("kind", ["short", "dark"])
def test_a_short_path_and_one_without_landmarks_are_not_searched(tmp_path: Path, kind: str) -> None:
    walk = ring(tmp_path / "clouds", alike=False)
    clouds, steps = walk.clouds, walk.steps
    if kind == "short":
        steps = steps.select(slice(100))
    else:
        clouds = CloudSet.from_clouds([PointCloud(one.points_in_cam) for one in clouds])
    assert not (is_long(clouds, steps, walk.drift, Revisits()) and uses_images(clouds, GlobalStart()))
