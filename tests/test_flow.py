"""Optical flow, poses by corners, and the rolling shutter."""

from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from hodge_adapters.tum.reader import READOUT_S, TumReader
from hodge_pipeline import se3
from hodge_pipeline.demo.sequence import DemoOptions, make_sequence
from hodge_pipeline.registration.pixels import back_project, project
from hodge_pipeline.registration.tracking.flow import Corners, FlowImage, find_corners, flow_image, follow
from hodge_pipeline.registration.tracking.readout import estimate_readout, with_readout
from hodge_pipeline.registration.tracking.reposing import PosedBlock, repose
from hodge_pipeline.registration.tracking.resection import resect
from hodge_pipeline.registration.tracking.shutter import at_frame_stamp, velocities
from hodge_pipeline.registration.tracking.sightings import Sightings, views
from hodge_pipeline.stages import Step, no_progress
from hodge_pipeline.start.at_stamps import at_stamps
from hodge_pipeline.store import artifacts
from hodge_pipeline.types import (
    Camera,
    CloudSet,
    Floats,
    Frame,
    Landmarks,
    PointCloud,
    Source,
)
from hodge_pipeline.types.notes import Note

CAMERA = Camera(640, 480, 525.0, 525.0, 319.5, 239.5)
ROLLING = Camera(640, 480, 525.0, 525.0, 319.5, 239.5, readout_s=0.0225)
MOTION = se3.exp(np.array([0.03, -0.05, 0.02, 0.04, -0.02, 0.03]))
RANGE = (0.2, 6.0)


def points_in_view(count: int, seed: int = 0) -> Floats:
    rng = np.random.default_rng(seed)
    z = rng.uniform(1.0, 3.0, count)
    return np.stack([rng.uniform(-0.5, 0.5, count) * z, rng.uniform(-0.4, 0.4, count) * z, z], axis=1)


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Source:
    options = DemoOptions(frames=4, width=320, height=240, stride=1, turns=0.01)
    return TumReader().open(make_sequence(tmp_path_factory.mktemp("flow") / "sequence", options))


def corners_of(source: Source) -> Corners:
    image = flow_image(source.frames[0], RANGE)
    assert image is not None
    return find_corners(image)


def test_a_pose_is_found_through_outliers_and_without_most_depths() -> None:
    points = points_in_view(100)
    seen = project(se3.transform(se3.inverse(MOTION), points), CAMERA)
    seen[:30, :2] += 40.0
    seen[40:90, 2] = np.nan
    found = resect(points, seen, CAMERA, np.eye(4))
    assert found is not None
    np.testing.assert_allclose(found.known_from_cam, MOTION, atol=1e-4)
    np.testing.assert_array_equal(found.inliers, np.arange(100) >= 30)


def test_its_information_says_how_far_noise_moves_it() -> None:
    rng, errors = np.random.default_rng(1), []
    for seed in range(40):
        points = points_in_view(200, seed)
        seen = project(se3.transform(se3.inverse(MOTION), points), CAMERA)
        seen[:, :2] += rng.normal(0, 0.75, (200, 2))
        seen[:, 2] = np.nan
        found = resect(points, seen, CAMERA, MOTION)
        assert found is not None
        error = se3.log(se3.inverse(MOTION) @ found.known_from_cam)
        errors.append(error @ found.information @ error)
    assert 3.0 < np.mean(errors) < 9.0  # χ² of six degrees of freedom; Cauchy weights make it less


def test_too_few_points_or_no_agreement_give_no_pose() -> None:
    points = points_in_view(11)
    assert resect(points, project(points, CAMERA), CAMERA, np.eye(4)) is None
    assert resect(points_in_view(60), project(points_in_view(60, 5), CAMERA), CAMERA, np.eye(4)) is None


def test_corners_are_followed_to_the_motion_of_the_camera(source: Source) -> None:
    first, last = source.frames[0], source.frames[3]
    view = flow_image(last, RANGE)
    assert view is not None
    found = follow(corners_of(source), view, np.eye(4))
    assert found is not None and len(found.rows) > 50 and found.share > 0.7
    assert first.world_from_cam is not None and last.world_from_cam is not None
    true = se3.inverse(first.world_from_cam) @ last.world_from_cam
    error = se3.log(se3.inverse(true) @ found.key_from_view)
    assert np.linalg.norm(true[:3, 3]) > 0.05
    # Colour is up to 6 ms earlier or later than depth, whose moment the true poses are of.
    assert np.linalg.norm(error[3:]) < 0.01 and np.linalg.norm(error[:3]) < 0.008


def test_a_black_frame_shows_nothing(source: Source) -> None:
    corners = corners_of(source)
    shape = corners.image.depth.shape
    black = FlowImage(np.zeros(shape, np.uint8), np.zeros(shape, np.float32), corners.image.camera, RANGE)
    assert len(find_corners(black)) == 0
    assert follow(corners, black, np.eye(4)) is None


@pytest.mark.parametrize("delay_s", [-0.018, 0.0, 0.015])
def test_a_point_goes_back_to_where_it_was_at_the_stamp(delay_s: float) -> None:
    twist = np.array([0.4, -0.3, 0.2, 0.3, 0.2, -0.3])
    at_stamp = points_in_view(50)
    seen = at_stamp
    for _ in range(5):  # the row says when it is seen, which says where
        rolled_s = ROLLING.readout_s * (project(seen, ROLLING)[:, 1] / ROLLING.height - 0.5)
        world_from_cam = se3.exp(twist * (rolled_s + delay_s)[:, None])
        seen = np.stack(
            [se3.transform(se3.inverse(T), p[None])[0] for T, p in zip(world_from_cam, at_stamp, strict=True)]
        )
    by_depth = np.stack(
        [se3.transform(se3.exp(-twist * s), p[None])[0] for s, p in zip(rolled_s, at_stamp, strict=True)]
    )
    mixed = seen * (by_depth[:, 2] / seen[:, 2])[:, None]  # the pixel of colour, the distance of depth
    before = np.linalg.norm(mixed - at_stamp, axis=1)
    after = np.linalg.norm(at_frame_stamp(mixed, ROLLING, delay_s, twist) - at_stamp, axis=1)
    assert before.max() > 0.004 and after.max() < 0.0006


def test_without_a_shutter_or_a_motion_nothing_moves() -> None:
    points = points_in_view(10)
    np.testing.assert_array_equal(at_frame_stamp(points, CAMERA, 0.0, np.ones(6)), points)
    np.testing.assert_array_equal(at_frame_stamp(points, ROLLING, 0.01, np.zeros(6)), points)


def test_velocities_come_from_the_frames_around_and_not_from_over_a_gap() -> None:
    twist, times = np.array([0.1, 0.2, -0.1, 0.3, 0.0, 0.2]), np.array([0.0, 0.04, 0.07, 3.0, 3.03, 3.06])
    poses, found = se3.exp(twist * times[:, None]), np.array([True, True, True, True, True, False])
    speeds = velocities(poses, times, np.zeros(6, np.int64), found)
    np.testing.assert_allclose(speeds[[0, 1]], [twist, twist], atol=1e-12)
    np.testing.assert_array_equal(speeds[[2, 3, 5]], np.zeros((3, 6)))  # over the gap, or without a pose
    np.testing.assert_array_equal(velocities(poses, times, np.arange(6), found), np.zeros((6, 6)))
    found[1] = False
    speed = velocities(poses, times, np.zeros(6, np.int64), found)[0]
    np.testing.assert_allclose(speed, twist, atol=1e-12)  # from the next but one


def rolling_block(readout_s: float) -> tuple[Sightings, PosedBlock, Floats]:
    """Three frames of a camera that speeds up, the first and the last are key frames; and the true poses."""
    times = np.array([0.0, 1 / 30, 2 / 30])
    twist = np.array([0.5, 0.4, 0.3, 0.4, -0.3, 0.2])

    def world_from_cam(times: Floats) -> Floats:
        return se3.exp(twist * (times + 10 * times**2)[:, None])

    poses = world_from_cam(times)
    world = points_in_view(80)

    def seen(frame: int) -> Floats:
        out = project(se3.transform(se3.inverse(poses[frame]), world), CAMERA)
        for _ in range(5):
            late = times[frame] + ROLLING.readout_s * (out[:, 1] / CAMERA.height - 0.5)
            views = se3.inverse(world_from_cam(late))
            out = project(np.einsum("nij,nj->ni", views[:, :3, :3], world) + views[:, :3, 3], CAMERA)
        return out

    first = seen(0)
    rays = np.stack([(first[:, 0] - CAMERA.cx) / CAMERA.fx, (first[:, 1] - CAMERA.cy) / CAMERA.fy, np.ones(80)], axis=1)
    key, corner = np.zeros(80, np.int64), np.tile(np.arange(80), 2)
    sightings = Sightings(key, rays * first[:, 2:], np.repeat([1, 2], 80), corner, np.concatenate([seen(1), seen(2)]))
    camera = Camera(640, 480, 525.0, 525.0, 319.5, 239.5, readout_s)
    start = poses.copy()
    start[1, :3, 3] += 0.02
    twists = twist * (1 + 20 * times)[:, None]
    block = PosedBlock(np.arange(3), start, np.array([True, False, True]), twists, (camera,) * 3, np.zeros(3))
    return sightings, block, poses


def test_frames_between_key_frames_are_posed_anew_at_the_shutter_of_their_camera() -> None:
    errors = []
    for readout_s in (0.0, ROLLING.readout_s):
        sightings, block, poses = rolling_block(readout_s)
        found = repose(sightings, block)
        assert found.rows.tolist() == [1] and len(found.misfits) == 0
        errors.append(np.abs(found.world_from_cam[0] - poses[1]).max())
    assert errors[1] < 1e-4 < errors[0]


def test_a_frame_that_fits_nothing_is_named() -> None:
    sightings, block, _ = rolling_block(0.0)
    sightings.seen[:80] = project(points_in_view(80, 9), CAMERA)
    found = repose(sightings, block)
    assert found.misfits.tolist() == [1] and len(found.rows) == 0


def test_a_block_that_saw_nothing_is_no_error() -> None:
    sightings, block, _ = rolling_block(0.0)
    nothing = Sightings(*(getattr(sightings, field.name)[:0] for field in fields(Sightings)))
    found = repose(nothing, replace(block, rows=block.rows[:0]))
    assert found.rows.shape == (0,) and found.world_from_cam.shape == (0, 4, 4) and found.misfits.shape == (0,)


def test_readers_tell_the_shutter_and_by_how_much_colour_is_late(tmp_path: Path, source: Source) -> None:
    folder = tmp_path / "rgbd_dataset_freiburg1_rolling"
    make_sequence(folder, DemoOptions(frames=3, width=64, height=48, stride=1))
    lines = (folder / "rgb.txt").read_text().splitlines()
    rows = [line.split() for line in lines if not line.startswith("#")]
    late = [f"{float(stamp) + 0.012:.6f} {name}" for stamp, name in rows]
    (before, *_) = TumReader(camera="fr1").open(folder).frames
    (folder / "rgb.txt").write_text("\n".join(late) + "\n")
    (frame, *_) = TumReader(camera="fr1").open(folder).frames
    assert frame.camera is not None and frame.camera.readout_s == READOUT_S
    assert 0 < abs(before.colour_delay_s) < 0.006
    assert frame.colour_delay_s - before.colour_delay_s == pytest.approx(0.012, abs=1e-6)
    assert source.frames[0].camera is not None and source.frames[0].camera.readout_s == 0.0


def shaken(times: Floats, speed: float = 1.0) -> Floats:
    """Poses of a shaken camera at these times."""
    phases = speed * (1 + np.arange(6)) * times[:, None]
    return se3.exp(0.1 * np.sin(7 * phases / np.arange(2, 8)) + 0.05 * np.cos(9 * phases / np.arange(3, 9)))


def rolled(world: Floats, time_s: float, readout_s: float, speed: float = 1.0) -> Floats:
    """Columns u, v, z of points in the world as that camera sees them at this time, row after row."""
    late = np.full(len(world), time_s)
    for _ in range(5):
        views = se3.inverse(shaken(late, speed))
        out = project(np.einsum("nij,nj->ni", views[:, :3, :3], world) + views[:, :3, 3], CAMERA)
        late = time_s + readout_s * (out[:, 1] / CAMERA.height - 0.5)
    return out


def shaken_views(folder: Path, readout_s: float, speed: float = 1.0) -> tuple[Floats, Floats]:
    """Sightings of a shaken camera of this read-out: 12 key frames with three frames each; poses and velocities."""
    times, rng = np.arange(49) / 30, np.random.default_rng(2)
    poses = shaken(times, speed)
    keys, points, frames, seen = [], [], [], []
    for key in range(0, 48, 4):
        world = se3.transform(poses[key], points_in_view(80, key))
        for row in range(key, key + 4):
            out = rolled(world, times[row], readout_s, speed)
            out[:, :2] += rng.normal(0, 0.3, (80, 2))
            if row == key:
                points.append(back_project(out, CAMERA))
                keys.append(np.full(80, key))
            else:
                frames.append(np.full(80, row))
                seen.append(out)
    corner = np.concatenate([np.tile(np.arange(80), 3) + 80 * block for block in range(12)])
    found = Sightings(*map(np.concatenate, (keys, points, frames)), corner, np.concatenate(seen))
    artifacts.save(folder / "0.npz", found)
    return poses, velocities(poses, times, np.zeros(49, np.int64), np.ones(49, bool))


def frames_of(camera: Camera | None) -> list[Frame]:
    return [Frame(row, row / 30, camera=camera) for row in range(49)]


def test_the_read_out_is_estimated_where_nobody_gives_it(tmp_path: Path) -> None:
    poses, twists = shaken_views(tmp_path, 0.0225)
    found = estimate_readout(views(tmp_path), frames_of(CAMERA), poses, twists, 1.0)
    assert found is not None and found.low_s < found.best_s < found.high_s
    assert found.best_s == pytest.approx(0.0225, abs=0.002)
    assert estimate_readout(views(tmp_path), frames_of(None), poses, twists, 1.0) is None
    assert estimate_readout(views(tmp_path), frames_of(CAMERA), poses, np.zeros_like(twists), 1.0) is None


@pytest.mark.parametrize(("real_s", "taken_s"), [(ROLLING.readout_s, None), (0.0, 0.0), (-ROLLING.readout_s, -0.0225)])
def test_a_camera_s_own_read_out_stands_unless_another_surely_fits_better(
    tmp_path: Path, real_s: float, taken_s: float | None
) -> None:
    poses, twists = shaken_views(tmp_path, real_s)
    found = estimate_readout(views(tmp_path), frames_of(ROLLING), poses, twists, 1.0)
    assert (found and found.best_s) == taken_s
    assert with_readout(ROLLING, taken_s).readout_s == real_s


@pytest.mark.parametrize("real_s", [ROLLING.readout_s, -ROLLING.readout_s])
def test_landmarks_of_frames_registered_whole_are_moved_by_the_read_out_that_they_fit(
    tmp_path: Path, real_s: float
) -> None:
    times, rng = np.arange(14) / 30, np.random.default_rng(3)
    poses, world = shaken(times), points_in_view(80)
    descriptors, pixel_rad = rng.integers(0, 255, (80, 128)).astype(np.uint8), np.full(80, 1 / CAMERA.fx, np.float32)
    clouds = []
    for time_s in times.tolist():
        seen = rolled(world, time_s, real_s)
        seen[:, :2] += rng.normal(0, 0.3, (80, 2))
        points = back_project(seen, CAMERA).astype(np.float32)
        clouds.append(PointCloud(points, landmarks=Landmarks(points, descriptors, pixel_rad)))
    CloudSet.from_clouds(clouds).save(tmp_path / "made")
    pairs = np.stack([np.arange(13), np.arange(1, 14)], axis=1)
    twists = velocities(poses, times, np.zeros(14, np.int64), np.ones(14, bool))
    frames = tuple(Frame(row, time_s, camera=ROLLING) for row, time_s in enumerate(times.tolist()))
    source, notes = Source("shaken", tmp_path, frames), list[Note]()
    (tmp_path / "clouds").mkdir()  # of a run that was killed
    made = CloudSet.open(tmp_path / "made")
    step = Step(tmp_path, no_progress, lambda *told: notes.extend(told))
    moved = at_stamps(source, made, poses, twists, pairs, 1.0, step=step)
    assert [note.kind for note in notes] == (["other readout"] if real_s < 0 else [])
    true = np.concatenate([se3.transform(se3.inverse(pose), world) for pose in poses])
    before_m, after_m = (float(np.median(np.linalg.norm(one.mark_points - true, axis=1))) for one in (made, moved))
    assert after_m < 0.6 * before_m


@pytest.mark.parametrize(("readout_s", "speed"), [(0.0, 1.0), (0.06, 1.0), (0.0225, 0.01)])
def test_no_read_out_is_estimated_without_a_clear_minimum(tmp_path: Path, readout_s: float, speed: float) -> None:
    poses, twists = shaken_views(tmp_path, readout_s, speed)  # read at once; slower than video; hardly moves
    assert estimate_readout(views(tmp_path), frames_of(CAMERA), poses, twists, 1.0) is None
