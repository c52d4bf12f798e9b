"""The pictures of scenes in a report: what is near hides what is far, rooms open towards the eye; nothing breaks."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from hodge_pipeline import se3
from hodge_pipeline.errors import SourceError
from hodge_pipeline.report import raster
from hodge_pipeline.report.contents import EdgeRow, Pictures, Report, SourceSummary, paths_of
from hodge_pipeline.report.error_plots import turns_deg
from hodge_pipeline.report.run_report import _pictures
from hodge_pipeline.report.scene_pictures import changed_most, four_sides, worst_pairs
from hodge_pipeline.scene import KeyFrames, Round, Scene, pose_sets
from hodge_pipeline.types import CloudSet, Edges, Floats, Frame, PointCloud, Solution, Source, ViewGraph
from hodge_pipeline.types.axes import up_and_ahead

pytestmark = pytest.mark.draws
RED, BLUE = (200, 0, 0), (0, 0, 200)
AHEAD = raster.View(np.eye(3), np.array([0.0, 0.0, 1.5]), 0.01)
"""Looks along +z with x to the right and y down; a pixel is 1 cm."""


def wall(z: float, towards: float, colour: tuple[int, int, int], reach: float = 0.5) -> raster.Points:
    """A square wall at depth z, dense enough to have no gaps, whose normal is (0, 0, towards)."""
    x, y = (axis.ravel() for axis in np.meshgrid(*[np.arange(-reach, reach, 0.008)] * 2))
    points = np.stack([x, y, np.full_like(x, z)], axis=1).astype(np.float32)
    normals = np.tile(np.float32([0, 0, towards]), (len(points), 1))
    return raster.Points(points, normals, np.tile(np.uint8(colour), (len(points), 1)))


def centre(scene: raster.Points) -> np.ndarray:
    image = raster.picture(scene, AHEAD)
    assert image.shape == (raster.HEIGHT, raster.WIDTH, 3) and (image[0, 0] == raster.PAPER).all()
    return image[raster.HEIGHT // 2, raster.WIDTH // 2]


def test_the_nearer_wall_hides_the_other_in_any_order() -> None:
    near, far = wall(1, -1, RED), wall(2, -1, BLUE)
    for scene in (raster.Points.joined([near, far]), raster.Points.joined([far, near])):
        assert centre(scene)[0] > 150 > centre(scene)[2]


def test_a_wall_that_faces_away_is_looked_through() -> None:
    assert centre(raster.Points.joined([wall(1, 1, RED), wall(2, -1, BLUE)]))[2] > 150


def test_it_is_where_it_should_be() -> None:
    """A wall of 1 m in pixels of 1 cm: 100 of them wide, and the gaps closed reach two further on each side."""
    image = raster.picture(wall(1, -1, RED), AHEAD)
    drawn = np.flatnonzero((image[raster.HEIGHT // 2] != raster.PAPER).any(axis=1))
    assert abs(len(drawn) - 100) <= 2 * raster.FILL_PX + 1
    assert abs(drawn.mean() - raster.WIDTH / 2) < 2


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
    image = np.asarray(Image.open(io.BytesIO(sides[0].image)), int)
    assert image.shape == (raster.HEIGHT, 2 * raster.WIDTH + 8, 3)
    left, right = image[:, : raster.WIDTH], image[:, -raster.WIDTH :]
    assert ((left.min(axis=2) < 200).sum(), (right.min(axis=2) < 200).sum()) > (0, 0)
    assert np.abs(left - right).max() > 100


def test_poses_before_in_another_world_are_seen_beside_those_after() -> None:
    clouds, poses = room()
    world_from_room = se3.exp(np.array([0.0, 0.0, 1.0, 1000.0, 2000.0, 30.0]))
    for before, after in ((poses, world_from_room @ poses), (world_from_room @ poses, poses)):
        front = four_sides(clouds, before, after, np.zeros(6, int))[0]
        image = np.asarray(Image.open(io.BytesIO(front.image)), int).min(axis=2)
        seen = [(half < 200).sum() for half in (image[:, : raster.WIDTH], image[:, -raster.WIDTH :])]
        assert seen[1] > 100 and seen[0] == pytest.approx(seen[1], rel=0.05)


def test_scanners_are_seen_with_their_own_z_up() -> None:
    tilted = se3.exp(np.array([[0.0, 0.1, 0.4, 1, 2, 3]]))
    up, ahead = up_and_ahead(tilted, is_scanner=True)
    assert up == pytest.approx(tilted[0, :3, 2]) and ahead == pytest.approx(tilted[0, :3, 0])


def test_what_lies_at_the_lower_edge_is_not_drawn_at_the_upper_one_too() -> None:
    size = (40, 30)
    row = np.column_stack([np.linspace(-15, 15, 31), np.full(31, 14.0), np.zeros(31)]).astype(np.float32)
    view = raster.View(np.eye(3), np.zeros(3), 1.0, size, culled=False, fill_px=3)
    image = raster.picture(raster.Points.of(row), view)
    assert (image[25:] < raster.PAPER).any() and (image[:20] == raster.PAPER).all()


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
    assert Image.open(io.BytesIO(pair.image)).size == (608, 225)


def test_two_points_of_one_surface_are_averaged_and_one_behind_it_is_not() -> None:
    near, same, far = wall(1, -1, (200, 0, 0)), wall(1.005, -1, (0, 0, 200)), wall(1.2, -1, (0, 200, 0))
    mean = centre(raster.Points.joined([near, same, far])).astype(int)
    assert abs(mean[0] - mean[2]) < 20 and mean[1] < 20


def test_in_perspective_what_is_twice_as_far_is_half_as_large() -> None:
    """The eye 1 m before the centre, where a pixel is 1 cm: a wall of 1 m at 1 m and at 2 m from the eye."""
    view = raster.View(np.eye(3), np.array([0, 0, 1.0]), 0.01, eye_m=1.0, fill_px=1)
    sizes = [(raster.picture(wall(z, -1, RED), view)[raster.HEIGHT // 2] < 255).any(axis=1).sum() for z in (1, 2)]
    assert abs(sizes[0] - 100) <= 4 and abs(sizes[1] - 50) <= 4
    assert (raster.picture(wall(-1, -1, RED), view) == raster.PAPER).all(), "behind the eye"


def test_the_place_that_changed_most_is_shown_before_and_after() -> None:
    clouds, poses = room()
    before = poses.copy()
    before[3, 0, 3] += 0.3
    pairs = np.array([[0, 1], [2, 3], [4, 5]])
    (picture,) = changed_most(clouds, before, poses, pairs, list("abcdef"), np.zeros(6, int))
    assert "what frame c sees" in picture.caption and "Frame d moved by 30 cm" in picture.caption
    image = np.asarray(Image.open(io.BytesIO(picture.image)), int)
    assert image.shape == (540, 2 * 720 + raster.GAP, 3)
    nowhere = np.full((6, 4, 4), np.nan)
    assert changed_most(clouds, nowhere, poses, pairs, list("abcdef"), np.zeros(6, int)) == ()


def test_the_rotation_error_of_each_frame_is_that_of_its_pose() -> None:
    """Against the truth where there is one, after the mean turn: a straight path says nothing of the turn about it. A
    frame without a pose has none, nor has a report of an earlier version.
    """
    turns, up = [20.0, 10, -10, 0, -20], [0.0, 0, 1, 0, 0, 0]
    truth = np.tile(np.eye(4), (5, 1, 1))
    turned = se3.exp(np.array(up) * 0.5) @ truth @ se3.exp(np.radians(np.outer(turns, up)))
    turned[3] = np.nan
    paths = paths_of({"truth": truth, "odometry": turned, "result": truth})
    report = Report("", SourceSummary("", "", 5), before="odometry", after="result", pictures=Pictures(paths=paths))
    found = turns_deg(report)
    np.testing.assert_allclose(found["odometry"], [20, 10, 10, np.nan, 20], atol=1e-6)
    np.testing.assert_allclose(found["result"], 0, atol=1e-6)
    without = replace(report, pictures=Pictures(paths=tuple(replace(path, rotations=None) for path in paths)))
    assert turns_deg(without) == {}
    assert turns_deg(replace(report, pictures=Pictures(paths=paths[1:]))) == {}, "nothing moved"
    before = replace(paths[1], positions=paths[1].positions + 1.0)
    moved = replace(report, pictures=Pictures(paths=(before, paths[2])))
    np.testing.assert_allclose(turns_deg(moved)["result"], [20, 10, 10, np.nan, 20], atol=1e-6)


@pytest.mark.parametrize(("joined_before", "moved_m"), [(False, 0.0), (True, 5.0)])
def test_pieces_that_the_start_laid_apart_have_not_moved_by_that(joined_before: bool, moved_m: float) -> None:
    clouds, poses = room()
    before, chain = poses.copy(), np.stack([np.arange(5), np.arange(1, 6)], axis=1)
    before[3:, 1, 3] += 10.0
    measured = Edges.measured(ViewGraph.from_edges(np.arange(6), chain, np.tile(np.eye(4), (5, 1, 1))))
    first = Round(measured if joined_before else measured.select(np.arange(5) != 2), np.arange(6), before)
    solved = Solution(poses, np.zeros(6, np.int64), np.ones(5))
    rounds = [first, Round(measured, np.arange(6), poses, solved)]
    source = Source("room", Path("room"), [Frame(row, float(row)) for row in range(6)])
    scene = Scene(source, source, KeyFrames.all_of(source, before), clouds, first)
    drawn = _pictures(scene, rounds, pose_sets(rounds, source), solved.component, ())
    shown = {path.name: path.positions for path in drawn.paths}
    assert np.linalg.norm(shown["odometry"] - shown["result"], axis=1).max() == pytest.approx(moved_m, abs=1.0)
    assert len(np.unique(drawn.component)) == (1 if joined_before else 2)
