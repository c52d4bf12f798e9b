"""Loops closed along the path: a camera that goes round a room twice, by odometry that drifts."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from hodge_pipeline import se3
from hodge_pipeline.demo.path import HandHeldLoop
from hodge_pipeline.demo.render import Renderer
from hodge_pipeline.demo.room import build_room
from hodge_pipeline.pairs.revisits import Revisits, find_revisits
from hodge_pipeline.scene import Round
from hodge_pipeline.stages import Step, no_progress
from hodge_pipeline.start.odometry import close_loops
from hodge_pipeline.types import Camera, CloudSet, Edges, Floats, PointCloud, Registration

FRAMES, TURNS = 72, 2.0
ONE = np.zeros(FRAMES, np.int64)
CAMERA = Camera(64, 48, 52.5, 52.5, 31.5, 23.5)


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> tuple[CloudSet, Floats]:
    """Clouds of a furnished room, seen twice all round, and the true poses."""
    renderer, path = Renderer(build_room(), CAMERA), HandHeldLoop(0, FRAMES / 6, TURNS)
    poses = path.world_from_cam(np.arange(FRAMES) / 6)
    clouds = []
    for pose in poses:
        z = renderer.depth(pose)[0]
        v, u = np.nonzero(z)
        rays = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones(len(u))], axis=1)
        clouds.append(PointCloud((rays * z[v, u, None]).astype(np.float32)))
    folder = tmp_path_factory.mktemp("clouds")
    CloudSet.from_clouds(clouds).save(folder)
    return CloudSet.open(folder), poses


def drifting(poses: Floats, twist: Floats) -> Floats:
    """The poses chained again from steps that each err by this twist."""
    steps = se3.inverse(poses[:-1]) @ poses[1:] @ se3.exp(twist)
    out = [poses[0]]
    for step in steps:
        out.append(out[-1] @ step)
    return np.array(out)


DRIFT = np.array([0, np.deg2rad(0.06), 0, 0, 0, 0.003])
"""Of each of 72 steps of 10°: 4° and 20 cm in the end."""


def test_what_is_seen_again_is_found_and_registered(walk: tuple[CloudSet, Floats]) -> None:
    clouds, true = walk
    found = find_revisits(clouds, drifting(true, DRIFT), ONE, Revisits())
    i, j = found.pairs.T
    assert len(found) >= 10 and (j - i).min() > 15
    assert 0 < len(find_revisits(clouds, drifting(true, DRIFT), ONE, Revisits(every_m=5.0))) < len(found)
    error = se3.log(se3.inverse(se3.inverse(true[i]) @ true[j]) @ found.i_from_j)
    assert np.linalg.norm(error[:, 3:], axis=1).max() < 0.05
    assert np.rad2deg(np.linalg.norm(error[:, :3], axis=1)).max() < 2


def test_odometry_that_drifts_by_almost_three_per_cent_is_followed(walk: tuple[CloudSet, Floats]) -> None:
    """As that of small images did through thirteen rooms: no loop was found after the second."""
    clouds, true = walk
    found = find_revisits(clouds, drifting(true, 5 * DRIFT), ONE, Revisits())
    assert len(found) >= 10
    error = se3.inverse(se3.inverse(true[found.pairs[:, 0]]) @ true[found.pairs[:, 1]]) @ found.i_from_j
    assert np.linalg.norm(error[:, :3, 3], axis=1).max() < 0.05
    assert not len(find_revisits(clouds, drifting(true, 5 * DRIFT), ONE, Revisits(most_m=0.3)))


def test_first_poses_are_put_right(walk: tuple[CloudSet, Floats], tmp_path: Path) -> None:
    clouds, true = walk
    start = drifting(true, DRIFT)
    pairs = np.stack([np.arange(FRAMES - 1), np.arange(1, FRAMES)], axis=1)
    steps = se3.inverse(start[:-1]) @ start[1:]
    known = [Registration(step, 1e4 * np.eye(6), 1.0, 0.0, 100, 1, True) for step in steps]
    first = Round(Edges.of(pairs, "sequential").with_registrations(known), np.arange(FRAMES), start)
    notes = []
    closed = close_loops(clouds, first, ONE, Revisits(), step=Step(tmp_path, no_progress, notes.append))
    off = np.linalg.norm(start[:, :3, 3] - true[:, :3, 3], axis=1)
    left = np.linalg.norm(closed.world_from_cam[:, :3, 3] - true[:, :3, 3], axis=1)
    assert left[-10:].mean() < off[-10:].mean() / 2
    assert notes[0].kind == "revisits" and notes[0].count == len(closed.pairs)


def test_a_place_farther_off_than_odometry_drifts_is_another_one(walk: tuple[CloudSet, Floats]) -> None:
    """Rooms that look alike: the same views again, but two metres from where they would have to be."""
    clouds, true = walk
    again = true.copy()
    again[FRAMES // 2 :, :3, 3] += [2.0, 0, 0]
    assert not len(find_revisits(clouds, again, ONE, Revisits()))


def test_a_path_that_never_comes_back_has_no_loops(walk: tuple[CloudSet, Floats]) -> None:
    clouds, true = walk
    away = true.copy()
    away[:, 0, 3] += np.arange(FRAMES)
    assert not len(find_revisits(clouds, away, ONE, Revisits()))


def test_between_parts_that_odometry_left_apart_no_loop_is_closed(walk: tuple[CloudSet, Floats]) -> None:
    clouds, true = walk
    halves = np.arange(FRAMES) // (FRAMES // 2)
    found = find_revisits(clouds, true, halves, Revisits())
    assert (halves[found.pairs[:, 0]] == halves[found.pairs[:, 1]]).all()
    assert len(find_revisits(clouds, true, ONE, Revisits())) > len(found)
