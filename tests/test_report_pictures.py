"""The photographs of a report: what is near hides what is far, a room is open towards the eye, nothing breaks them."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
from PIL import Image

from hodge_pipeline.errors import SourceError
from hodge_pipeline.report import splat
from hodge_pipeline.report.contents import EdgeRow
from hodge_pipeline.report.sides import four_sides, worst_pairs
from hodge_pipeline.types import CloudSet, Floats, Frame, PointCloud, Source

RED, BLUE = (200, 0, 0), (0, 0, 200)
AHEAD = splat.Stand(np.eye(3), np.array([0.0, 0.0, 1.5]), 0.01)
"""Looks along +z with x to the right and y down; a pixel is 1 cm."""


def wall(z: float, towards: float, colour: tuple[int, int, int], reach: float = 0.5) -> splat.Scene:
    """A square wall at depth z, dense enough to have no gaps, whose normal is (0, 0, towards)."""
    x, y = (axis.ravel() for axis in np.meshgrid(*[np.arange(-reach, reach, 0.008)] * 2))
    points = np.stack([x, y, np.full_like(x, z)], axis=1).astype(np.float32)
    normals = np.tile(np.float32([0, 0, towards]), (len(points), 1))
    return splat.Scene(points, normals, np.tile(np.uint8(colour), (len(points), 1)))


def both(a: splat.Scene, b: splat.Scene) -> splat.Scene:
    joined = (np.concatenate([getattr(a, n), getattr(b, n)]) for n in ("points", "normals", "colours"))
    return splat.Scene(*joined)


def centre(scene: splat.Scene) -> np.ndarray:
    image = splat.picture(scene, AHEAD)
    assert image.shape == (splat.HEIGHT, splat.WIDTH, 3) and (image[0, 0] == splat.PAPER).all()
    return image[splat.HEIGHT // 2, splat.WIDTH // 2]


def test_the_nearer_wall_hides_the_other_in_any_order() -> None:
    near, far = wall(1, -1, RED), wall(2, -1, BLUE)
    for scene in (both(near, far), both(far, near)):
        assert centre(scene)[0] > 150 > centre(scene)[2]


def test_a_wall_that_faces_away_is_looked_through() -> None:
    assert centre(both(wall(1, 1, RED), wall(2, -1, BLUE)))[2] > 150


def test_it_is_where_it_should_be() -> None:
    """A wall of 1 m in pixels of 1 cm: 100 of them wide, and the gaps closed reach two further on each side."""
    image = splat.picture(wall(1, -1, RED), AHEAD)
    drawn = np.flatnonzero((image[splat.HEIGHT // 2] != splat.PAPER).any(axis=1))
    assert abs(len(drawn) - 100) <= 2 * splat.FILL_PASSES + 1
    assert abs(drawn.mean() - splat.WIDTH / 2) < 2


def room(count: int = 6) -> tuple[CloudSet, Floats]:
    """Frames along x, each seeing a coloured wall 2 m ahead."""
    seen = wall(2, -1, RED, reach=1)
    cloud = PointCloud(seen.points, seen.normals, seen.colours)
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, 0, 3] = 0.2 * np.arange(count)
    return CloudSet.from_clouds([cloud] * count), poses


def test_four_sides_are_jpegs_of_both_sets_of_poses() -> None:
    clouds, poses = room()
    before = poses.copy()
    before[3, 2, 3] = -1.0  # one frame's wall stands apart
    sides = four_sides(clouds, before, poses, np.zeros(6, int))
    assert [side.title for side in sides] == ["From the front", "From the right", "From the back", "From the left"]
    image = np.asarray(Image.open(io.BytesIO(sides[0].jpeg)), int)
    assert image.shape == (splat.HEIGHT, 2 * splat.WIDTH + 8, 3)
    left, right = image[:, : splat.WIDTH], image[:, -splat.WIDTH :]
    assert ((left.min(axis=2) < 200).sum(), (right.min(axis=2) < 200).sum()) > (0, 0)
    assert np.abs(left - right).max() > 100


def test_frames_that_show_nothing_are_no_error() -> None:
    clouds, poses = room(3)
    assert four_sides(clouds, np.full((3, 4, 4), np.nan), poses, np.zeros(3, int)) == ()
    empty = CloudSet.from_clouds([PointCloud(np.zeros((0, 3), np.float32))] * 3)
    assert four_sides(empty, poses, poses, np.zeros(3, int)) == ()
    grey = CloudSet.from_clouds([PointCloud(clouds[0].points_in_cam, clouds[0].normals_in_cam)] * 3)
    assert len(four_sides(grey, poses, poses, np.zeros(3, int))) == 4


def broken() -> np.ndarray:
    raise SourceError("cannot be read")


def test_worst_pairs_show_colour_or_depth_and_leave_out_what_cannot_be_read() -> None:
    frames = [
        Frame(0, 0.0, read_colour=lambda: np.full((48, 64, 3), 90, np.uint8)),
        Frame(1, 1.0, read_depth=lambda: np.full((48, 64), 2.0, np.float32)),
        Frame(2, 2.0, read_colour=broken),
        Frame(3, 3.0),
    ]
    edges = [EdgeRow(i, j, "overlap", 0.5, 1.0, 0.1, 2.0) for i, j in (("0", "1"), ("0", "2"), ("1", "3"), ("0", "9"))]
    (pair,) = worst_pairs(Source("s", Path("s"), frames), edges)
    assert pair.title == "0 – 1" and "10 cm" in pair.caption
    assert Image.open(io.BytesIO(pair.jpeg)).size == (606, 225)
