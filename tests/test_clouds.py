"""From frames to clouds: hand answers, order, colours, and what happens to frames that give nothing."""

import weakref
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from hodge_pipeline.errors import SourceError
from hodge_pipeline.executors.local import InProcess
from hodge_pipeline.fusion.cloud import depth_points
from hodge_pipeline.registration import clouds as clouds_module
from hodge_pipeline.registration import voxel_means
from hodge_pipeline.registration.cloud_set import FRAMES_IN_BLOCK, prepare_clouds
from hodge_pipeline.registration.clouds import CloudOptions, make_cloud
from hodge_pipeline.stages import Step
from hodge_pipeline.start.clouds import add_landmarks
from hodge_pipeline.types import Camera, CloudSet, Frame, PointCloud, Source
from hodge_pipeline.types.notes import Rank

CAMERA = Camera(64, 48, 60.0, 60.0, 32.0, 24.0)
WALL_M = 1.995  # the middle of a 3 cm voxel, so that rounding never splits the wall in two


class Backwards:
    """Workers that finish the last block first."""

    def map(self, task: Callable[[Any], Any], blocks: Sequence[Any]) -> Iterator[tuple[int, Any]]:
        return ((row, task(blocks[row])) for row in reversed(range(len(blocks))))


class Counting:
    """Workers that count how many sets of clouds that they made are held at once."""

    def __init__(self) -> None:
        self._held, self.most = weakref.WeakSet[CloudSet](), 0

    def map(self, task: Callable[[Any], Any], blocks: Sequence[Any]) -> Iterator[tuple[int, Any]]:
        for row, block in enumerate(blocks):
            result = task(block)
            self._held.add(result if isinstance(result, CloudSet) else result[0])
            self.most = max(self.most, len(self._held))
            yield row, result


def wall(z: float) -> np.ndarray:
    return np.full((CAMERA.height, CAMERA.width), z, np.float32)


def unreadable() -> np.ndarray:
    raise SourceError("depth/7.png: truncated: copy it again")


def frame(depth: np.ndarray, frame_id: int = 0, **more: Any) -> Frame:
    return Frame(frame_id, float(frame_id), CAMERA, read_depth=lambda: depth, **more)


def test_a_wall_gives_its_plane_and_normals_towards_the_camera() -> None:
    cloud, counts = make_cloud(frame(wall(WALL_M)), CloudOptions())
    assert np.allclose(cloud.points_in_cam[:, 2], WALL_M, atol=1e-6)
    assert np.allclose(cloud.normals_in_cam, [0, 0, -1], atol=1e-4)
    assert counts.looked_at == counts.valid == 48 * 64
    corner = [-32 / 60 * WALL_M, -24 / 60 * WALL_M]
    assert np.allclose(cloud.points_in_cam[:, :2].min(axis=0), corner, atol=0.03)


@pytest.mark.parametrize(("width", "stride"), [(640, 2), (320, 1), (160, 1)])
def test_no_pixel_of_a_small_image_is_skipped(width: int, stride: int) -> None:
    height, focal = width * 3 // 4, width * 525 / 640
    camera = Camera(width, height, focal, focal, width / 2, height / 2)
    depth = np.full((height, width), 4.0, np.float32)
    _, counts = make_cloud(Frame(0, 0.0, camera, read_depth=lambda: depth), CloudOptions())
    assert counts.looked_at == width * height / stride**2


def test_one_pixel_is_back_projected_where_the_camera_equation_says() -> None:
    depth = np.zeros((CAMERA.height, CAMERA.width), np.float32)
    depth[10, 50] = 1.5
    flipped = Camera(64, 48, 60.0, -60.0, 32.0, 24.0)  # ICL-NUIM: y points up
    for camera, y in ((CAMERA, (10 - 24) / 60 * 1.5), (flipped, -(10 - 24) / 60 * 1.5)):
        cloud, counts = make_cloud(Frame(0, 0.0, camera, read_depth=lambda: depth), CloudOptions())
        assert np.allclose(cloud.points_in_cam, [[(50 - 32) / 60 * 1.5, y, 1.5]], atol=1e-6)
        assert counts.valid == 1
        assert np.array_equal(cloud.normals_in_cam, [[0, 0, 0]])  # too few points for a plane


@pytest.mark.parametrize("z", [0.0, 0.1, 6.5, np.nan, np.inf, -1.0])
def test_what_is_out_of_range_is_an_empty_cloud_with_a_note(z: float) -> None:
    cloud, counts = make_cloud(frame(wall(z), frame_id=3), CloudOptions())
    assert len(cloud) == counts.valid == 0
    assert "frame 3: no valid measurement" in str(counts.odd)
    assert ("is source.reader.depth_scale right?" in str(counts.odd)) == (z in (0.1, 6.5))


def test_colours_are_averaged_and_an_image_of_another_size_is_looked_up() -> None:
    image = np.zeros((CAMERA.height * 2, CAMERA.width * 2, 3), np.uint8)
    image[:, CAMERA.width :] = [200, 100, 50]
    cloud, _ = make_cloud(frame(wall(WALL_M), read_colour=lambda: image), CloudOptions())
    assert cloud.colours is not None
    x = cloud.points_in_cam[:, 0]
    assert (cloud.colours[x < -0.05] == 0).all()
    assert (cloud.colours[x > 0.05] == [200, 100, 50]).all()


@pytest.mark.parametrize("side", [3, 5])
def test_a_pixel_has_the_colour_in_its_middle_in_a_finer_image_of_the_same_view(side: int) -> None:
    image = np.zeros((CAMERA.height * side, CAMERA.width * side, 3), np.uint8)
    image[side // 2 :: side, side // 2 :: side] = [200, 100, 50]
    registered, _ = make_cloud(frame(wall(WALL_M), read_colour=lambda: image), CloudOptions())
    fused = depth_points(wall(WALL_M), image, CAMERA, 2, 0.2, 6.0)
    for cloud in (registered, fused):
        assert cloud.colours is not None and (cloud.colours == [200, 100, 50]).all()


def test_a_colour_image_that_cannot_be_read_costs_the_colours_alone() -> None:
    cloud, counts = make_cloud(frame(wall(WALL_M), frame_id=7, read_colour=unreadable), CloudOptions())
    assert len(cloud) > 100
    assert not cloud.colours.any()
    assert "frame 7: its cloud has no colours: depth/7.png" in str(counts.odd)


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=20, deadline=None)
def test_the_order_of_a_scanners_points_does_not_matter(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1, 1, (300, 3)).astype(np.float32)
    clouds = [
        make_cloud(Frame(0, 0.0, read_points=partial(PointCloud, part)), CloudOptions(voxel_m=0.2))[0].points_in_cam
        for part in (points, rng.permutation(points))
    ]
    assert np.allclose(*clouds, atol=1e-6)


def test_a_scanners_range_is_a_distance_and_lost_points_are_dropped() -> None:
    points = np.array([[-3, 0, 0], [0, 0, -7], [np.nan, 0, 1], [np.inf, 0, 1], [0.05, 0, 0]], np.float32)
    cloud, counts = make_cloud(Frame(0, 0.0, read_points=lambda: PointCloud(points)), CloudOptions())
    assert np.array_equal(cloud.points_in_cam, [[-3, 0, 0]])
    assert (counts.looked_at, counts.valid) == (5, 1)


def test_no_returns_of_scans_are_counted_in_one_note(tmp_path: Path) -> None:
    """Zeros and NaN, whether the reader leaves them out or not; depth images have holes, and no note."""
    from hodge_adapters.clouds.columns import points_of_columns

    table = np.random.default_rng(0).uniform(1, 2, (40, 3)).astype(np.float32)
    table[:5], table[5:7] = 0, np.nan
    cloud = points_of_columns(tmp_path, dict(zip("xyz", table.T, strict=True)))
    assert (len(cloud), cloud.no_numbers) == (38, 2)
    scans = [Frame(k, float(k), read_points=lambda: cloud) for k in range(2)]
    _, notes = prepare_clouds(scans, CloudOptions(), InProcess(), tmp_path)
    assert tuple(map(str, notes)) == ("14 of 80 points (17.5%) are no returns (zero, or no number): left out",)
    holes = wall(WALL_M)
    holes[:9] = 0
    assert prepare_clouds([frame(holes)], CloudOptions(), InProcess(), tmp_path)[1] == ()


def test_clouds_come_in_the_order_of_the_frames_and_bad_frames_are_said(tmp_path: Path) -> None:
    frames = [frame(wall(0.5 + 0.1 * k), k) for k in range(40)]
    frames[7] = Frame(7, 7.0, CAMERA, read_depth=unreadable)
    frames[9] = frame(wall(0.0), 9)
    done: list[int] = []
    clouds, notes = prepare_clouds(frames, CloudOptions(), Backwards(), tmp_path, done.append)
    depths = [cloud.points_in_cam[:, 2].mean() for row, cloud in enumerate(clouds) if row not in (7, 9)]
    assert np.allclose(depths, [0.5 + 0.1 * k for k in range(40) if k not in (7, 9)], atol=1e-5)
    assert clouds.sizes[[7, 9]].tolist() == [0, 0]
    assert notes[0].kind == "no cloud" and notes[0].count == 2 and notes[0].rank < Rank.FACT
    assert "truncated: copy it again" in str(notes[0]), "the ten lines of a report say what to do"
    assert [str(note).split(":")[0] for note in notes[1:]] == ["frame 7", "frame 9"]
    assert sum(done) == 40


def test_clouds_and_landmarks_are_written_as_they_are_made(tmp_path: Path) -> None:
    """Of 20,000 frames landmarks have half a gigabyte; the points, which stay the same, lie on the disk once."""
    seen = np.random.default_rng(0).integers(0, 256, (48, 64, 3)).astype(np.uint8)
    frames = tuple(frame(wall(1.0 + 0.001 * k), k, read_colour=lambda: seen) for k in range(10 * FRAMES_IN_BLOCK))
    workers, options = Counting(), CloudOptions(landmarks=20)
    bare, _ = prepare_clouds(frames, CloudOptions(), workers, tmp_path / "bare")
    step = Step(tmp_path, lambda _: None, lambda *_: None)
    found = add_landmarks(Source("wall", tmp_path, frames), bare, options, workers=workers, step=step)
    assert workers.most <= 3
    whole = CloudSet.from_clouds([make_cloud(one, options)[0] for one in frames])
    assert whole.marks[-1] > len(frames)
    for name in CloudSet.FILES:
        assert np.array_equal(getattr(found, name), getattr(whole, name)), name
    assert (tmp_path / "clouds" / "points.npy").samefile(tmp_path / "bare" / "points.npy")
    add_landmarks(Source("wall", tmp_path, frames[:1]), bare, options, workers=workers, step=step)
    assert np.array_equal(np.load(tmp_path / "bare" / "points.npy"), whole.points), "it was written over"


def test_of_many_frames_with_the_same_fault_the_first_are_named_and_the_others_counted(tmp_path: Path) -> None:
    frames = [frame(wall(WALL_M), k, read_colour=unreadable) for k in range(40)]
    frames[30] = frame(wall(0.0), 30)
    _, notes = prepare_clouds(frames, CloudOptions(), InProcess(), tmp_path)
    notes = tuple(note for note in notes if note.kind == "clouds")
    assert [str(note).split(":")[0] for note in notes[:6]] == [*(f"frame {k}" for k in range(5)), "frame 30"]
    assert tuple(map(str, notes[6:])) == ("34 more frames: its cloud has no colours, as of those before",)


@pytest.mark.parametrize(
    ("seen", "said"),
    [
        (np.zeros((48, 64, 3), np.uint8), True),
        (np.full((24, 32, 3), (90, 120, 200), np.uint8), True),
        (np.arange(48 * 64 * 3, dtype=np.uint8).reshape(48, 64, 3) // 10, False),
    ],
    ids=["black", "blue", "underexposed"],
)
def test_frames_whose_colour_image_shows_nothing_are_said(seen: np.ndarray, said: bool, tmp_path: Path) -> None:
    frames = [frame(wall(WALL_M), k, read_colour=lambda: seen) for k in range(25)]
    frames[0] = frame(wall(0.0), 0, read_colour=lambda: seen)
    clouds, notes = prepare_clouds(frames, CloudOptions(), InProcess(), tmp_path)
    assert (clouds.sizes[1:] > 100).all()
    named = [str(note) for note in notes if "colour image shows nothing" in str(note)]
    assert len(named) == (6 if said else 0)
    assert not said or (named[0].startswith("frame 1: ") and named[-1].startswith("19 more frames: "))


def test_no_cloud_at_all_is_an_error_with_the_first_reason(tmp_path: Path) -> None:
    for frames, reason in (
        ([Frame(k, 0.0, CAMERA, read_depth=unreadable) for k in range(3)], "none of the 3 frames.*truncated"),
        ([], "no frames"),
    ):
        with pytest.raises(SourceError, match=reason):
            prepare_clouds(frames, CloudOptions(), InProcess(), tmp_path)


@pytest.mark.parametrize(
    "options",
    [{"min_range_m": 2.0, "max_range_m": 1.0}, {"voxel_m": 1e-9}, {"stride": 0}, {"voxel": 0.1}],
)
def test_options_that_mean_nothing_are_refused(options: dict[str, Any]) -> None:
    with pytest.raises(ValidationError):
        CloudOptions(**options)


def test_a_real_frame(data_dir: Path, tmp_path: Path) -> None:
    from hodge_adapters.seven_scenes.reader import SevenScenesReader

    path = data_dir / "seven_scenes" / "redkitchen"
    if not path.is_dir():
        pytest.skip(f"no {path}")
    frames = SevenScenesReader().open(path).frames[:2]
    read, notes = prepare_clouds(frames, CloudOptions(), InProcess(), tmp_path)
    assert notes == ()
    assert 8000 < read.sizes[0] < 9500
    for cloud in read:
        lengths = np.linalg.norm(cloud.normals_in_cam, axis=1)
        assert np.allclose(lengths, 1, atol=1e-3)
        assert (np.einsum("ij,ij->i", cloud.normals_in_cam, cloud.points_in_cam) <= 0).all()
        assert cloud.colours.any(axis=1).mean() > 0.95


def test_a_large_cloud_is_averaged_in_parts_as_it_is_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(0)
    points, colours = rng.normal(size=(5000, 3)).astype(np.float32), rng.integers(0, 256, (5000, 3)).astype(np.uint8)
    whole = voxel_means.voxel_means(points, colours, 0.3)
    monkeypatch.setattr(voxel_means, "POINTS_IN_PART", 700)
    parts = voxel_means.voxel_means(points, colours, 0.3)
    assert np.allclose(whole[0], parts[0], atol=1e-6) and np.array_equal(whole[1], parts[1])
    assert len(whole[0]) == len(np.unique(np.floor(points / 0.3), axis=0))


def test_voxels_that_are_near_the_least_of_their_cloud_are_apart() -> None:
    points = np.array([[0.05, 0.05, 0.15], [0.05, 0.05, 0.16], [0.25, 0.05, 0.35]], np.float32)
    means, _ = voxel_means.voxel_means(points, None, 0.1)
    np.testing.assert_allclose(means, [[0.05, 0.05, 0.155], [0.25, 0.05, 0.35]], atol=1e-6)


def test_a_scan_of_many_points_is_said_to_be_down_sampled(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(clouds_module, "MANY_POINTS", 1000)
    points = np.random.default_rng(0).uniform(-1, 1, (2000, 3)).astype(np.float32)
    frame = Frame(7, 0.0, read_points=lambda: PointCloud(points))
    cloud, counts = make_cloud(frame, CloudOptions(voxel_m=0.5, min_range_m=0.0))
    assert str(counts.odd) == f"frame 7: down-sampled in parts: 2000 points to {len(cloud)}, one a voxel of 0.5 m"


@pytest.mark.parametrize("level", [0, 128, 255])
def test_an_even_image_is_blank_whatever_surrounds_it(level: int) -> None:
    image = np.full((120, 160, 3), level, np.uint8)
    image[::7, ::9] -= level > 0  # a sensor's noise
    image[:, :6] = 0  # beside a bent lens' image that was made straight
    assert clouds_module.is_blank(image) and clouds_module.is_blank(image[:, :, 0])
    image[40:60, 40:60] = 60
    assert not clouds_module.is_blank(image) and not clouds_module.is_blank(image[:, :, 0])


def test_clouds_on_disk_give_their_memory_back(tmp_path: Path) -> None:
    points = np.random.default_rng(0).normal(size=(1_000_000, 3)).astype(np.float32)
    CloudSet.from_clouds([PointCloud(part) for part in np.split(points, 1000)]).save(tmp_path)
    clouds = CloudSet.open(tmp_path)

    def resident_kb() -> int:
        """Of this file of points, in this process."""
        parts = Path("/proc/self/smaps").read_text().split(f"{clouds.points.filename}\n")[1:]
        return sum(int(part.split("Rss:")[1].split()[0]) for part in parts)

    if not Path("/proc/self/smaps").is_file():
        pytest.skip("this system has no /proc/self/smaps, which tells the memory of a file")
    total = clouds.points.sum(dtype=float)
    whole = resident_kb()
    assert whole > 10_000
    clouds.forget()
    assert resident_kb() < 1_000
    assert sum(cloud.points_in_cam.sum(dtype=float) for cloud in clouds) == pytest.approx(total)
    assert resident_kb() < whole / 2  # a system may map a file in pieces of megabytes
    assert sum(clouds[row].points_in_cam.sum(dtype=float) for row in range(999, -1, -1)) == pytest.approx(total)
    assert resident_kb() < whole / 2


@pytest.mark.parametrize(
    ("scale", "away_m", "told"),
    [
        (1, (500_000, 5_000_000, 100), "map coordinates? Subtract one corner from all scans"),
        (1000, (0, 0, 0), "millimetres? then source.reader.units_per_metre=1000"),
        (1, (9, 9, 9), "(is source.reader.units_per_metre right?)"),
    ],
)
def test_points_out_of_range_are_told_by_where_they_lie(scale: float, away_m: tuple[float, ...], told: str) -> None:
    points = scale * np.random.default_rng(0).uniform(-3, 3, (200, 3)) + away_m
    _, counts = make_cloud(Frame(0, 0.0, read_points=lambda: PointCloud(points.astype(np.float32))), CloudOptions())
    assert told in str(counts.odd)
    assert ("rounds them to 0.5 m" in str(counts.odd)) == (away_m[0] > 1e5)
