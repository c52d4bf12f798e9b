from __future__ import annotations

import hashlib
import os
from pathlib import Path

import numpy as np
import open3d as o3d
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import map_coordinates

from hodge_adapters.tum.reader import TumReader
from hodge_pipeline import se3
from hodge_pipeline.demo import room as room_module
from hodge_pipeline.demo import sequence
from hodge_pipeline.demo.noise import RANGE_M, measured_depth, photographed
from hodge_pipeline.demo.path import HandHeldLoop, Walk
from hodge_pipeline.demo.render import Renderer
from hodge_pipeline.demo.room import Room, build_building, build_room
from hodge_pipeline.demo.sequence import BuildingOptions, DemoOptions, demo_source, make_sequence
from hodge_pipeline.demo.shapes import Mesh, ball, box, curtain, cylinder, lathe
from hodge_pipeline.demo.textures import make_textures
from hodge_pipeline.errors import SourceError
from hodge_pipeline.types import Camera, Frame
from synthetic import SHORT, TINY, short_sequence, tiny_sequence  # noqa: F401

CAMERA = DemoOptions(width=160, height=120).camera
SMALLEST = DemoOptions(frames=2, width=16, height=16)


@pytest.fixture(scope="module")
def room() -> Room:
    return build_room(0)


def digest(folder: Path) -> dict[str, str]:
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def area(mesh: Mesh) -> float:
    a, b, c = (mesh.vertices[mesh.triangles[:, k]] for k in range(3))
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)


# Shapes


def test_areas_by_hand() -> None:
    assert area(box(1, 2, 3)) == pytest.approx(22)
    assert area(ball(0.5, sides=96)) == pytest.approx(np.pi, rel=5e-3)
    assert area(cylinder(0.5, 2.0, sides=96)) == pytest.approx(2.5 * np.pi, rel=5e-3)


@pytest.mark.parametrize(
    "mesh", [box(1, 2, 3), ball(0.3), cylinder(0.1, 1), curtain(1, 2, 4, 0.1), lathe([(0.2, 0), (0.1, 0.5), (0, 0.5)])]
)
def test_vertex_normals_are_unit_and_across_their_triangles(mesh: Mesh) -> None:
    assert np.allclose(np.linalg.norm(mesh.normals, axis=1), 1)
    a, b, c = (mesh.vertices[mesh.triangles[:, k]] for k in range(3))
    across = np.cross(b - a, c - a)
    size = np.linalg.norm(across, axis=1)
    kept = size > 1e-9
    cosine = np.einsum("ti,tci->tc", across[kept] / size[kept, None], mesh.normals[mesh.triangles[kept]])
    assert np.abs(cosine).min() > 0.7


# Textures


@settings(max_examples=20, deadline=None)
@given(u=st.integers(0, 255), v=st.integers(0, 255), shift=st.integers(-3, 3), level=st.floats(-2, 9))
def test_textures_repeat(room: Room, u: int, v: int, shift: int, level: float) -> None:
    texture = np.arange(len(room.textures.names))
    uv = np.tile((np.array([u, v]) + 0.25) / 256, (len(texture), 1))
    footprint = np.full(len(texture), 2.0**level / 256)
    colours = room.textures.sample(texture, uv, footprint)
    assert np.allclose(colours, room.textures.sample(texture, uv + shift, footprint), atol=1e-5)
    assert colours.min() >= 0 and colours.max() <= 1 + 1e-6


# The room and its rendering


def test_depth_of_the_floor_by_hand(room: Room) -> None:
    """Straight down from 1.3 m over bare floor: 1.3 m everywhere, and it is depth, not length of the ray."""
    camera = Camera(9, 9, 20.0, 20.0, 4.0, 4.0)
    down = se3.from_parts(np.diag([1.0, -1.0, -1.0]), np.array([0.9, 1.4, 1.3]))
    depth_m, facing = Renderer(room, camera).depth(down)
    assert np.allclose(depth_m, 1.3, atol=1e-4)
    assert facing[4, 4] == pytest.approx(1) and facing[4, 8] == pytest.approx(20 / np.hypot(20, 4), abs=1e-4)


def test_the_two_desks_look_alike(room: Room) -> None:
    renderer = Renderer(room, Camera(80, 60, 80.0, 80.0, 39.5, 29.5))
    right, forward = np.array([1.0, 0, 0]), np.array([0, 0.9, -np.sqrt(0.19)])
    rotation = np.stack([right, np.cross(forward, right), forward], axis=1)
    first = se3.from_parts(rotation, np.array([2.0, 0.9, 1.4]))
    half_turn = se3.from_parts(np.diag([-1.0, -1.0, 1.0]), np.zeros(3))
    one, other = renderer.depth(first)[0], renderer.depth(half_turn @ first)[0]
    assert np.mean(np.abs(one - other) < 1e-3) > 0.97
    assert np.ptp(one) > 0.5


def test_glass_is_seen_but_not_measured(room: Room) -> None:
    renderer = Renderer(room, CAMERA)
    forward, right = np.array([1.0, 0, 0]), np.array([0, -1.0, 0])
    pose = se3.from_parts(np.stack([right, np.cross(forward, right), forward], axis=1), np.array([0.6, 0.5, 1.6]))
    depth_m, facing = renderer.depth(pose)
    glass = (depth_m == 0) & (facing > 0)
    assert 0.02 < glass.mean() < 0.5
    assert renderer.colour(pose)[glass].mean() > 0.7


def warped_error(frame_i: Frame, frame_j: Frame, i_from_j: np.ndarray) -> float:
    """The median |depth difference| of cloud j, moved into camera i, from the depth image i at the same pixels."""
    camera = CAMERA
    depth_i, depth_j = frame_i.read_depth(), frame_j.read_depth()
    row, column = np.nonzero(depth_j > 0)
    z = depth_j[row, column]
    points = np.stack([(column - camera.cx) / camera.fx * z, (row - camera.cy) / camera.fy * z, z], axis=1)
    x, y, z = se3.transform(i_from_j, points).T
    u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
    inside = (z > 0) & (u > 0) & (u < camera.width - 1) & (v > 0) & (v < camera.height - 1)
    # The inverse depth of a plane is linear over the image, so that linear interpolation is exact on it.
    inverse_i = np.where(depth_i > 0, 1 / np.maximum(depth_i, 0.1), np.nan)
    seen = map_coordinates(inverse_i, [v[inside], u[inside]], order=1)
    return float(np.nanmedian(np.abs(1 / seen - z[inside])))


@pytest.mark.parametrize(("noise", "tolerance_m"), [(0.0, 0.001), (1.0, 0.025)])
def test_neighbouring_frames_coincide_under_the_true_poses_only(
    tmp_path: Path, noise: float, tolerance_m: float
) -> None:
    options = DemoOptions(frames=4, width=160, height=120, noise=noise, turns=0.06)
    frames = TumReader().open(make_sequence(tmp_path / "demo", options)).frames
    for one, other in zip(frames[:-1], frames[1:], strict=True):
        i_from_j = se3.inverse(one.world_from_cam) @ other.world_from_cam
        assert warped_error(one, other, i_from_j) < tolerance_m
        assert warped_error(one, other, se3.inverse(i_from_j)) > 0.05


# Video


def test_rows_of_a_rolling_shutter_are_those_of_images_at_their_own_times(room: Room) -> None:
    renderer, poses = Renderer(room, CAMERA), np.broadcast_to(np.eye(4), (CAMERA.height, 4, 4)).copy()
    begin, end = HandHeldLoop(0, 4.0, turns=0.3).world_from_cam(np.array([1.0, 1.02]))
    poses[:60], poses[60:] = begin, end
    for make in (renderer.colour, lambda pose: renderer.depth(pose)[0]):
        rolled, first, last = (make(pose) for pose in (poses, begin, end))
        for own, other, rows in ((first, last, slice(0, 60)), (last, first, slice(60, None))):
            assert np.mean(np.abs(rolled[rows] - own[rows]) > 0.01) < 0.01
            assert np.mean(np.abs(rolled[rows] - other[rows]) > 0.01) > 0.05


def test_blur_is_the_mean_over_the_exposure(room: Room) -> None:
    renderer, times_s = Renderer(room, CAMERA), np.linspace(0.98, 1.02, 21)
    poses = HandHeldLoop(0, 4.0, turns=0.3).world_from_cam(times_s)
    mean = np.mean([renderer.colour(pose) for pose in poses], axis=0)
    blurred = renderer.colour(poses[10], se3.log(se3.inverse(poses[0]) @ poses[-1]))
    sharp = renderer.colour(poses[10])
    assert np.abs(blurred - mean).mean() < 0.5 * np.abs(sharp - mean).mean()


def test_a_video_says_how_its_shutter_rolls(tmp_path: Path) -> None:
    options = DemoOptions.video(frames=2, width=32, height=24)
    camera = TumReader().open(make_sequence(tmp_path / "video", options)).frames[0].camera
    assert camera == options.camera and camera.readout_s == 0.0225
    (tmp_path / "video/intrinsics.txt").write_text("fx: 525\nfy: 525\ncx: 320\ncy: 240\nreadout_s: 22.5\n")
    with pytest.raises(SourceError, match="readout_s 22.5 is no time in seconds"):
        TumReader().open(tmp_path / "video")


# Path


def test_the_path_returns_and_stays_hand_held() -> None:
    steady = HandHeldLoop(0, 20.0, turns=1.0, tremor_m=0, tremor_deg=0).world_from_cam(np.array([0.0, 20.0]))
    assert np.allclose(steady[0], steady[1])
    back = HandHeldLoop(0, 4.0, turns=0.1, tremor_m=0, tremor_deg=0).world_from_cam(np.array([0.0, 2.0, 4.0]))
    assert np.allclose(back[0], back[2]) and np.linalg.norm(back[1, :3, 3] - back[0, :3, 3]) > 0.4
    assert np.all(se3.is_motion(steady, 1e-9))


def test_truth_at_100_hz_interpolates_to_a_tenth_of_a_millimetre() -> None:
    loop = HandHeldLoop(0, 20.0, turns=1.12)
    times_s = np.arange(0, 20, 0.01)
    poses, between = loop.world_from_cam(times_s), loop.world_from_cam(times_s[:-1] + 0.005)
    error = se3.log(se3.inverse(between) @ se3.interpolate(poses[:-1], poses[1:], np.full(len(between), 0.5)))
    assert np.abs(error[:, 3:]).max() < 1e-4 and np.abs(error[:, :3]).max() < 2e-4


# Noise


def test_error_of_depth_grows_with_its_square() -> None:
    rng = np.random.default_rng(0)
    spread = [
        np.std(measured_depth(np.full((120, 160), z, np.float32), np.ones((120, 160), np.float32), rng, 1.0))
        for z in (1.0, 3.0)
    ]
    assert spread[1] / spread[0] == pytest.approx(9, rel=0.15)
    assert 0.010 < spread[1] < 0.02


def test_depth_is_dropped_out_of_range_when_grazed_and_at_edges() -> None:
    rng = np.random.default_rng(0)
    depth_m = np.full((60, 80), 2.0, np.float32)
    depth_m[:, :10], depth_m[:, 10:20], depth_m[:, 50:] = RANGE_M[0] - 0.05, RANGE_M[1] + 0.4, 3.0
    facing = np.ones_like(depth_m)
    facing[:, 30:40] = 0.05
    measured = measured_depth(depth_m, facing, rng, 1.0)
    assert not measured[:, :19].any() and not measured[:, 31:39].any()
    assert (measured[:, 22:29] > 0).all() and (measured[:, 52:] > 0).all()
    assert 0.1 < (measured[:, 49:51] > 0).mean() < 0.6


def test_without_noise_images_are_exact() -> None:
    rng = np.random.default_rng(0)
    depth_m = np.linspace(0.5, 4, 48, dtype=np.float32).reshape(6, 8)
    assert np.array_equal(measured_depth(depth_m, np.ones_like(depth_m), rng, 0.0), depth_m)
    image = np.linspace(0, 1, 144, dtype=np.float32).reshape(6, 8, 3)
    assert np.array_equal(photographed(image, rng, 0.0), np.floor(255 * image + 0.5).astype(np.uint8))


# The sequence


def test_the_reader_finds_everything(tiny_sequence: Path) -> None:  # noqa: F811
    source = TumReader().open(tiny_sequence)
    assert len(source.frames) == TINY.frames and source.frames[0].camera == TINY.camera
    for frame in source.frames:
        depth_m, colour = frame.read_depth(), frame.read_colour()
        assert (depth_m > 0).mean() > 0.6 and RANGE_M[0] < depth_m[depth_m > 0].min() and depth_m.max() < RANGE_M[1]
        assert colour.shape == (120, 160, 3) and colour.std() > 15
    poses = np.stack([frame.world_from_cam for frame in source.frames])
    steps = se3.log(se3.inverse(poses[:-1]) @ poses[1:])
    assert np.linalg.norm(steps[:, 3:], axis=1).max() < 0.15
    assert np.degrees(np.linalg.norm(steps[:, :3], axis=1).max()) < 9
    assert np.linalg.norm(poses[-1, :3, 3] - poses[0, :3, 3]) < 0.1
    assert np.linalg.norm(poses[12, :3, 3] - poses[0, :3, 3]) > 0.4


def test_the_same_options_give_the_same_bytes(
    short_sequence: Path,  # noqa: F811
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(room_module, "make_textures", make_textures)  # made anew, as conftest.py has them not
        again = make_sequence(tmp_path / "again", SHORT)
    assert digest(again) == digest(short_sequence)
    assert digest(make_sequence(tmp_path / "a", SMALLEST)) != digest(
        make_sequence(tmp_path / "b", DemoOptions(frames=2, width=16, height=16, seed=1))
    )


def test_a_sequence_is_made_once_and_progress_adds_up(tmp_path: Path) -> None:
    done: list[int] = []
    folder = make_sequence(tmp_path / "deep" / "demo", SMALLEST, done.append)
    stamps = {path: path.stat().st_mtime_ns for path in folder.rglob("*")}
    assert make_sequence(folder, SMALLEST, done.append) == folder
    assert {path: path.stat().st_mtime_ns for path in folder.rglob("*")} == stamps
    assert sum(done) == 4 and [path.name for path in folder.parent.iterdir()] == ["demo"]


def test_a_folder_with_anything_else_is_refused_and_left(tmp_path: Path) -> None:
    (tmp_path / "thesis.txt").write_text("years of work")
    with pytest.raises(SourceError, match="name another folder"):
        make_sequence(tmp_path, SMALLEST)
    assert (tmp_path / "thesis.txt").read_text() == "years of work" and len(list(tmp_path.iterdir())) == 1


def test_an_interrupted_run_leaves_nothing(tmp_path: Path) -> None:
    def interrupt(done: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        make_sequence(tmp_path / "demo", SMALLEST, interrupt)
    assert not list(tmp_path.iterdir())


def test_where_nothing_can_be_written_the_error_says_so(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(SourceError, match="cannot write the demo sequence"):
        make_sequence(tmp_path / "file" / "demo", SMALLEST)


def test_the_cache_is_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(sequence, "CACHED_SEQUENCES", 1)
    cache = tmp_path / "hodge-pipeline"
    (cache / ".demo-0-x.partial").mkdir(parents=True)
    os.utime(cache / ".demo-0-x.partial", (0, 0))
    (cache / "demo-of-mine").mkdir()
    first = demo_source(options=SMALLEST)
    second = demo_source(options=DemoOptions(frames=3, width=16, height=16))
    assert first.parent == cache and not first.exists()
    assert {path.name for path in cache.iterdir()} == {"demo-of-mine", second.name}


@pytest.mark.parametrize(("frames", "rounds"), [(24, 24 * 3.4 / 720), (115, 0.5), (120, 1.12), (500, 1.12)])
def test_short_sequences_go_as_far_as_small_steps_reach(frames: int, rounds: float) -> None:
    assert DemoOptions(frames=frames).rounds == pytest.approx(rounds)


def test_the_walk_goes_through_doors_and_back_at_a_walking_pace() -> None:
    walk = Walk(seed=0, rooms=3)
    times = np.arange(0, walk.duration_s, 1 / 30)
    poses = walk.world_from_cam(times)
    steps = se3.log(se3.inverse(poses[:-1]) @ poses[1:])
    assert np.linalg.norm(steps[:, 3:], axis=1).max() < 0.05
    assert np.rad2deg(np.linalg.norm(steps[:, :3], axis=1)).max() < 4.5
    ahead = poses[:, :3, 2]
    room = poses[:, 1, 3] < 2.4
    turned = np.abs(np.diff(np.unwrap(np.arctan2(ahead[room, 1], ahead[room, 0])))).sum()
    assert turned > 4 * np.pi, "all round in the first room, on the way there and on the way back"
    places = poses[:, :3, 3].astype(np.float32)
    assert np.linalg.norm(places[-1] - places[0]) < 0.5 and places[:, 1].max() > 9, "the third room and back"
    building = build_building(3)
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(
        o3d.core.Tensor.from_numpy(building.vertices.astype(np.float32)),
        o3d.core.Tensor.from_numpy(building.triangles.astype(np.uint32)),
    )
    near = scene.compute_distance(o3d.core.Tensor.from_numpy(places)).numpy()
    crossed = scene.test_occlusions(
        o3d.core.Tensor.from_numpy(np.concatenate([places[:-1], np.diff(places, axis=0)], axis=1)), tnear=0.0, tfar=1.0
    ).numpy()
    assert near.min() > 0.15 and not crossed.any()


def test_rooms_of_a_building_are_lit_and_look_different() -> None:
    building = build_building(2)
    images = []
    for lamp in np.unique(building.lamp, axis=0):
        pose = se3.from_parts(np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]), lamp - [0.3, 1.8, 0.4])
        images.append(Renderer(building, BuildingOptions(rooms=2, width=80, height=60).camera).colour(pose))
    assert all(image.mean() > 0.2 for image in images)
    assert np.abs(images[0] - images[1]).mean() > 0.01


def test_a_building_is_read_whole(tmp_path: Path) -> None:
    options = BuildingOptions(rooms=2, width=32, height=24, stride=60)
    source = TumReader().open(make_sequence(tmp_path / "building", options))
    assert len(source.frames) == options.frames > 10
    assert all(frame.true_world_from_cam is not None for frame in source.frames)
