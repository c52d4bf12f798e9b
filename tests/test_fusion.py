"""Fusers: a modelled box whose surface is known, what is left out and said, bounds of memory, real frames."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from hodge_adapters.seven_scenes.reader import SevenScenesReader
from hodge_pipeline import se3
from hodge_pipeline.errors import SourceError
from hodge_pipeline.fusion import block_grid, tsdf
from hodge_pipeline.fusion.boxes import boxes_of
from hodge_pipeline.fusion.cloud import CloudFuser, VoxelCloud
from hodge_pipeline.fusion.tsdf import TsdfFuser
from hodge_pipeline.types import Camera, Frame, Model, PointCloud

CAMERA = Camera(width=80, height=60, fx=60.0, fy=60.0, cx=39.5, cy=29.5)
Y_UP = Camera(width=80, height=60, fx=60.0, fy=-60.0, cx=39.5, cy=29.5)
HALF = np.array([1.5, 1.0, 2.0])
"""The box: walls at ± HALF metres, seen from inside."""
WALL_COLOURS = np.array([[200, 0, 0], [0, 200, 0], [0, 0, 200]], np.uint8)


def box_view(world_from_cam: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Depth and colour of the box: each wall has the colour of its axis."""
    v, u = np.mgrid[0 : camera.height, 0 : camera.width]
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], axis=-1)
    rays = rays @ world_from_cam[:3, :3].T
    with np.errstate(divide="ignore"):
        distance = np.where(rays > 0, HALF - world_from_cam[:3, 3], -HALF - world_from_cam[:3, 3]) / rays
    wall = np.argmin(distance, axis=-1)
    return distance.min(axis=-1).astype(np.float32), WALL_COLOURS[wall]


def depth_of(world_from_cam: np.ndarray, camera: Camera) -> np.ndarray:
    return box_view(world_from_cam, camera)[0]


def colour_of(world_from_cam: np.ndarray, camera: Camera) -> np.ndarray:
    return box_view(world_from_cam, camera)[1]


def box_frames(count: int = 8, camera: Camera = CAMERA) -> tuple[list[Frame], np.ndarray]:
    """Views from near the centre, a turn of 0.05 radians between two of them."""
    poses = se3.exp(np.array([[0.02 * k, 0.05 * k, 0, 0.03 * k, 0, -0.5] for k in range(count)]))
    if camera.fy < 0:
        poses = poses @ np.diag([1.0, -1.0, 1.0, 1.0])
    frames = [
        Frame(k, k / 30, camera, partial(depth_of, pose, camera), partial(colour_of, pose, camera))
        for k, pose in enumerate(poses)
    ]
    return frames, poses


def fail(error: Exception) -> np.ndarray:
    raise error


def off_walls(points: np.ndarray) -> np.ndarray:
    """The distance of points to the nearest wall."""
    return np.asarray(np.abs(np.abs(points) - HALF).min(axis=1))


def assert_same(a: Model, b: Model) -> None:
    for name in ("points_in_world", "normals_in_world", "colours", "triangles"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))


BOTH = pytest.mark.parametrize("fuser", [TsdfFuser(voxel_m=0.04), CloudFuser(voxel_m=0.04, stride=1)])


@BOTH
def test_the_model_lies_on_the_walls_with_their_normals_and_colours(fuser: TsdfFuser | CloudFuser) -> None:
    frames, poses = box_frames()
    done: list[int] = []
    model = fuser.fuse(frames, poses, done.append)
    assert sum(done) == len(frames) and model.notes == ()
    points, normals, colours = model.points_in_world, model.normals_in_world, model.colours
    assert len(points) > 1000 and normals is not None and colours is not None
    assert np.percentile(off_walls(points), 95) < 0.01
    axis = np.argmin(np.abs(np.abs(points) - HALF), axis=1)
    inner = (np.sort(np.abs(np.abs(points) - HALF), axis=1)[:, 1] > 0.15) & (np.abs(normals).max(axis=1) > 0)
    rows = np.flatnonzero(inner)
    facing = -np.sign(points[rows, axis[rows]]) * normals[rows, axis[rows]]
    assert np.percentile(facing, 5) > 0.95
    assert np.percentile(np.abs(colours[rows].astype(int) - WALL_COLOURS[axis[rows]]).max(axis=1), 95) < 10


def test_slanted_walls_have_no_bias() -> None:
    """Half a pixel aside would move the side walls by 2 cm here."""
    points = TsdfFuser(voxel_m=0.04).fuse(*box_frames()).points_in_world
    for axis, sign in ((0, 1), (1, -1)):
        beside = np.delete(HALF - np.abs(points), axis, axis=1).min(axis=1)
        wall = points[(np.abs(sign * points[:, axis] - HALF[axis]) < 0.1) & (beside > 0.15)]
        assert len(wall) > 50
        assert abs((np.abs(wall[:, axis]) - HALF[axis]).mean()) < 0.002


@BOTH
def test_an_image_with_y_up_gives_the_same_model(fuser: TsdfFuser | CloudFuser) -> None:
    down = fuser.fuse(*box_frames())
    up = fuser.fuse(*box_frames(camera=Y_UP))
    assert len(up.points_in_world) == pytest.approx(len(down.points_in_world), rel=0.01)
    assert np.percentile(off_walls(up.points_in_world), 95) < 0.01
    assert up.normals_in_world is not None
    inward = -np.einsum("ij,ij->i", up.normals_in_world, up.points_in_world)
    assert (inward >= 0).mean() > 0.99


@BOTH
def test_frames_that_cannot_be_used_are_counted(fuser: TsdfFuser | CloudFuser) -> None:
    frames, poses = box_frames(8)
    poses[2, 0, 3] = np.nan
    for row, error in ((4, SourceError("x.png: cut short")), (5, FileNotFoundError("y.png"))):
        frames[row] = Frame(row, 0.0, CAMERA, partial(fail, error))
    frames[6] = Frame("bare", 0.0)
    done: list[int] = []
    model = fuser.fuse(frames, poses, done.append)
    assert sum(done) == 8
    assert model.notes[0] == "1 frame skipped: its pose is unknown (the first: 2)"
    bare, unread = sorted(model.notes[1:])
    assert unread == "2 frames skipped: cannot be read (the first: 4: x.png: cut short)"
    assert bare.startswith("1 frame skipped: ") and bare.endswith("(the first: bare)")
    kept = [0, 1, 3, 7]
    assert_same(model, fuser.fuse([frames[k] for k in kept], poses[kept]))


@BOTH
def test_an_error_of_the_program_is_not_swallowed(fuser: TsdfFuser | CloudFuser) -> None:
    frames, poses = box_frames(2)
    frames[1] = Frame(1, 0.0, CAMERA, partial(fail, ZeroDivisionError()))
    with pytest.raises(ZeroDivisionError):
        fuser.fuse(frames, poses)


@BOTH
def test_frames_without_geometry_are_an_error_that_names_the_stage(fuser: TsdfFuser | CloudFuser) -> None:
    with pytest.raises(SourceError, match=f"fusion: {'tsdf' if isinstance(fuser, TsdfFuser) else 'cloud'}: .* has"):
        fuser.fuse([Frame("a", 0.0)], np.eye(4)[None])


@BOTH
def test_nothing_gives_an_empty_model(fuser: TsdfFuser | CloudFuser) -> None:
    assert len(fuser.fuse([], np.zeros((0, 4, 4))).points_in_world) == 0
    frames, poses = box_frames(1)
    blank = Frame(0, 0.0, CAMERA, partial(np.zeros, (60, 80), np.float32))
    model = fuser.fuse([blank], poses)
    assert len(model.points_in_world) == 0 and model.notes[0].startswith("1 frame skipped: no ")
    far = Frame(0, 0.0, CAMERA, partial(np.full, (60, 80), 9.0, np.float32))
    assert fuser.fuse([far, frames[0]], poses[[0, 0]]).notes[0] == model.notes[0]


def test_only_every_second_frame() -> None:
    frames, poses = box_frames(8)
    done: list[int] = []
    model = TsdfFuser(voxel_m=0.04, every=2).fuse(frames, poses, done.append)
    assert sum(done) == 8
    assert_same(model, TsdfFuser(voxel_m=0.04).fuse(frames[::2], poses[::2]))


def test_frames_that_hardly_moved_are_not_read() -> None:
    frames, poses = box_frames(4)
    still = [replace(frame, read_depth=partial(fail, AssertionError("read"))) for frame in frames]
    twice = [one for pair in zip(frames, still, strict=True) for one in pair]
    done: list[int] = []
    model = TsdfFuser(voxel_m=0.04, min_motion_m=0.05).fuse(twice, np.repeat(poses, 2, axis=0), done.append)
    assert sum(done) == 8
    assert_same(model, TsdfFuser(voxel_m=0.04).fuse(frames, poses))
    assert model.notes == ("4 of 8 frames fused: one each min_motion_m = 0.05 of the path",)


def test_a_scene_too_large_for_one_grid_has_the_mesh_of_one() -> None:
    frames, poses = box_frames()
    whole = TsdfFuser(voxel_m=0.02).fuse(frames, poses)
    done: list[int] = []
    in_boxes = TsdfFuser(voxel_m=0.02, memory_limit_mb=50).fuse(frames, poses, done.append)
    assert sum(done) == 8 and in_boxes.notes == whole.notes == ()
    assert corners(in_boxes) == corners(whole)
    assert len(np.unique(in_boxes.points_in_world, axis=0)) == len(in_boxes.points_in_world), "seams are closed"


def corners(model: Model) -> set[tuple[float, ...]]:
    """Each triangle by its corners, with their normals and colours, the least first."""
    assert model.triangles is not None and model.colours is not None and model.normals_in_world is not None
    columns = np.concatenate([model.points_in_world, model.normals_in_world, model.colours], axis=1)
    rows = columns[model.triangles]
    least = np.array([min(range(3), key=lambda k, row=row: tuple(row[k])) for row in rows])
    turned = rows[np.arange(len(rows))[:, None], (least[:, None] + np.arange(3)) % 3]
    return set(map(tuple, turned.reshape(len(rows), -1).tolist()))


def test_a_grid_that_grows_keeps_what_it_holds(monkeypatch: pytest.MonkeyPatch) -> None:
    frames, poses = box_frames(4)
    whole = TsdfFuser(voxel_m=0.05).fuse(frames, poses)
    monkeypatch.setattr(block_grid, "FIRST_BLOCKS", 10)
    assert_same(TsdfFuser(voxel_m=0.05).fuse(frames, poses), whole)


def test_the_mesh_is_coarser_where_memory_is_short(monkeypatch: pytest.MonkeyPatch) -> None:
    frames, poses = box_frames()
    done: list[int] = []
    monkeypatch.setattr(tsdf, "BYTES_A_VERTEX", 2000)
    model = TsdfFuser(voxel_m=0.02, memory_limit_mb=50).fuse(frames, poses, done.append)
    assert sum(done) == 8
    assert len(model.notes) == 1 and "instead of 0.02 m" in model.notes[0] and "memory_limit_mb = 50" in model.notes[0]
    coarse = float(model.notes[0].split()[2])
    plain = TsdfFuser(voxel_m=coarse).fuse(frames, poses)
    assert coarse > 0.02 and plain.notes == ()
    assert corners(model) == corners(plain)


@given(
    arrays(np.int64, st.tuples(st.integers(0, 60), st.just(3)), elements=st.integers(-9, 9)).map(
        lambda blocks: np.unique(blocks, axis=0)
    ),
    st.integers(27, 60),
)
def test_boxes_hold_each_block_once_and_no_more_than_they_may(blocks: np.ndarray, most: int) -> None:
    boxes = list(boxes_of(blocks, most))
    held = np.array([box.holds(blocks) for box in boxes]).reshape(len(boxes), len(blocks))
    assert (held.sum(axis=0) == 1).all() and bool(boxes) == bool(len(blocks))
    assert all(box.around.holds(blocks).sum() <= most for box in boxes)


def test_the_mesh_without_colour_has_the_same_surface() -> None:
    frames, poses = box_frames()
    grey, coloured = (TsdfFuser(voxel_m=0.04, colour=colour).fuse(frames, poses) for colour in (False, True))
    assert grey.colours is None
    bare = [Frame(f.frame_id, 0.0, CAMERA, f.read_depth) for f in frames]
    assert TsdfFuser(voxel_m=0.04).fuse(bare, poses).colours is None
    np.testing.assert_array_equal(grey.points_in_world, coloured.points_in_world)


def test_a_surface_seen_too_rarely_is_left_out_and_said() -> None:
    frames, poses = box_frames(4)
    poses[2:, 0, 3] += 100.0
    model = TsdfFuser(voxel_m=0.04, min_weight=2).fuse(frames, poses)
    assert model.triangles is not None and len(model.triangles) == 0
    assert model.notes == ("the mesh is empty: no surface was seen by more than min_weight = 2 frames",)
    assert len(TsdfFuser(voxel_m=0.04, min_weight=1).fuse(frames, poses).points_in_world) > 1000


@pytest.mark.parametrize("count", [1, 2, 3])
def test_of_no_more_frames_than_min_weight_a_surface_needs_all(count: int) -> None:
    frames, poses = box_frames(count)
    model = TsdfFuser(voxel_m=0.04, min_weight=3).fuse(frames, poses)
    assert len(model.points_in_world) > 1000 and model.notes == ()
    assert_same(model, TsdfFuser(voxel_m=0.04, min_weight=count - 1).fuse(frames, poses))


@BOTH
def test_a_frame_whose_image_is_damaged_is_fused_without_its_colour(fuser: TsdfFuser | CloudFuser) -> None:
    frames, poses = box_frames(4)
    whole = fuser.fuse(frames, poses)
    damaged = partial(fail, SourceError("x.jpg: cut short"))
    frames[1] = Frame(1, 0.0, CAMERA, frames[1].read_depth, damaged)
    advances = list[int]()
    model = fuser.fuse(frames, poses, advances.append)
    assert sum(advances) == len(frames) and min(advances) >= 0
    assert model.notes == ("1 frame fused without colour: its image cannot be read (the first: 1: x.jpg: cut short)",)
    np.testing.assert_allclose(model.points_in_world, whole.points_in_world, atol=1e-6)  # in another order
    assert model.colours is not None
    blind = [Frame(f.frame_id, 0.0, CAMERA, f.read_depth, damaged) for f in frames]
    bare = fuser.fuse(blind, poses)
    assert bare.colours is None and bare.notes[0].startswith("4 frames fused without colour: ")
    np.testing.assert_array_equal(bare.points_in_world, whole.points_in_world)


def test_an_empty_grid_is_not_fused_again_with_coarser_voxels() -> None:
    frames = [Frame("bare", 0.0), box_frames(1)[0][0]]
    model = TsdfFuser(voxel_m=0.04).fuse(frames, np.full((2, 4, 4), np.nan))
    assert len(model.points_in_world) == 0
    assert not any("instead of" in note for note in model.notes)


def test_a_voxel_holds_the_mean() -> None:
    cloud = VoxelCloud(voxel_m=1.0, max_points=1000)
    points = np.array([[0.2, 0.2, 0.2], [0.4, 0.6, 0.8], [5.5, 0, 0]])
    colours = np.array([[0, 10, 255], [4, 20, 255], [1, 2, 3]], np.uint8)
    normals = np.array([[1.0, 0, 0], [0, 1.0, 0], [0, 0, 0]])
    assert cloud.add(points, colours, normals) == 0
    assert cloud.add(points[:1] + 1e9, None, None) == 1
    means, unit_normals, mean_colours = cloud.points()
    assert means == pytest.approx(np.array([[0.3, 0.4, 0.5], [5.5, 0, 0]]))
    assert unit_normals == pytest.approx(np.array([[0.5**0.5, 0.5**0.5, 0], [0, 0, 0]]))
    assert mean_colours.tolist() == [[2, 15, 255], [1, 2, 3]]


def test_a_cloud_in_parts_is_the_cloud_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(5)
    parts = rng.uniform(-3, 3, (12, 500, 3))
    monkeypatch.setattr("hodge_pipeline.fusion.cloud.MERGE_AT", 700)
    many, once = VoxelCloud(0.5, 10_000), VoxelCloud(0.5, 10_000)
    once.origin = np.floor(parts[0].mean(axis=0))
    for part in parts:
        many.add(part, None, None)
    once.add(parts.reshape(-1, 3), None, None)
    np.testing.assert_allclose(many.points()[0], once.points()[0], atol=1e-6)


def test_a_cloud_past_its_bound_doubles_its_voxels() -> None:
    points = np.random.default_rng(6).uniform(-3, 3, (5000, 3))
    cloud, coarse = VoxelCloud(0.125, 1000), VoxelCloud(1.0, 1000)
    cloud.add(points, None, None)
    coarse.add(points, None, None)
    means = cloud.points()[0]
    assert cloud.voxel_m == 1.0 and len(means) <= 1000
    np.testing.assert_allclose(means, coarse.points()[0], atol=1e-6)
    frames, poses = box_frames()
    model = CloudFuser(voxel_m=0.01, max_points=1000).fuse(frames, poses)
    assert 0 < len(model.points_in_world) <= 1000 and "max_points = 1000" in model.notes[0]


def points_of(cloud: PointCloud) -> PointCloud:
    return cloud


def test_frames_of_points_are_moved_into_the_world_far_from_its_origin() -> None:
    cloud = PointCloud(np.array([[1, 0, 0], [np.nan, 0, 0]], np.float32), np.array([[1, 0, 0], [0, 0, 0]], np.float32))
    frames = [Frame(k, 0.0, read_points=partial(points_of, cloud)) for k in range(2)]
    poses = se3.from_parts(se3.so3_exp(np.array([0, 0, np.pi / 2])), np.array([[4e4, 0, 0], [4e4, 0, 9]]))
    model = CloudFuser().fuse(frames, poses)
    assert model.points_in_world == pytest.approx(np.array([[4e4, 1, 0], [4e4, 1, 9]]), abs=1e-3)
    assert model.normals_in_world == pytest.approx(np.array([[0, 1, 0], [0, 1, 0]]), abs=1e-6)
    assert model.colours is None


def test_images_of_two_sizes_share_the_field_of_view() -> None:
    frames, poses = box_frames()
    large = Camera(width=160, height=120, fx=120.0, fy=120.0, cx=79.5, cy=59.5)
    both = [
        Frame(f.frame_id, 0.0, CAMERA, f.read_depth, partial(colour_of, pose, large))
        for f, pose in zip(frames, poses, strict=True)
    ]
    for fuser in (TsdfFuser(voxel_m=0.04), CloudFuser(voxel_m=0.04)):
        a, b = fuser.fuse(frames, poses), fuser.fuse(both, poses)
        np.testing.assert_array_equal(a.points_in_world, b.points_in_world)
        assert a.colours is not None and b.colours is not None
        assert (np.abs(a.colours.astype(int) - b.colours).max(axis=1) < 60).mean() > 0.95


def test_red_kitchen_is_a_room(data_dir: Path) -> None:
    reader = SevenScenesReader()
    folder = data_dir / "seven_scenes" / "redkitchen"
    if not folder.is_dir():
        pytest.skip(f"{folder} is absent")
    frames = reader.open(folder).frames[:25:5]
    poses = np.array([frame.world_from_cam for frame in frames])
    mesh, cloud = TsdfFuser(voxel_m=0.03).fuse(frames, poses), CloudFuser(voxel_m=0.03, stride=4).fuse(frames, poses)
    assert mesh.notes == cloud.notes == ()
    for model in (mesh, cloud):
        extent = np.ptp(model.points_in_world, axis=0)
        assert len(model.points_in_world) > 5000 and (extent > 1).all() and (extent < 8).all()
