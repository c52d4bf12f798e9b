"""Long sequences: key frames, the poses of the frames between them, frames that show nothing, resume."""

import json
import shutil
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import pytest

import hodge_pipeline
from hodge_adapters.trajectories.text import parse_tum
from hodge_adapters.tum.reader import TumReader
from hodge_pipeline import se3
from hodge_pipeline.complex.components import in_runs
from hodge_pipeline.demo.sequence import DemoOptions, make_sequence
from hodge_pipeline.errors import SourceError
from hodge_pipeline.executors.local import InProcess
from hodge_pipeline.fusion.cloud import CloudFuser
from hodge_pipeline.fusion.fuse import fuse_all
from hodge_pipeline.pairs.edits import Edit, History, write_history
from hodge_pipeline.recipe.schema import Recipe, load_recipe
from hodge_pipeline.registration.tracking import tracker
from hodge_pipeline.registration.tracking.blocks import TrackedBlocks
from hodge_pipeline.registration.tracking.focal import Focal
from hodge_pipeline.registration.tracking.readout import Readout
from hodge_pipeline.registration.tracking.tracker import TrackingOptions, frame_blocks, track_block
from hodge_pipeline.rounds.all_frames import pose_frames
from hodge_pipeline.scene import Scene, key_source
from hodge_pipeline.stages import Step, no_progress
from hodge_pipeline.start import key_frames as tracked
from hodge_pipeline.start.key_frames import KeyFrameStart, Tracked, followers
from hodge_pipeline.store.store import stored
from hodge_pipeline.types import Floats, Floats32, Frame, Source
from hodge_pipeline.types.notes import Note
from hodge_pipeline.uses.recipe_run import solve_again
from stand_ins import Log, Told

FRAMES, BLOCK, FUSED = 64, 48, "fusion=[cloud]"


SMALL = (
    "clouds.voxel_m=0.06", "fusion=[]", "executor.workers=0", "recording.level=off", "evaluation.tables=false",
    "outer_iterations=1", "edges.max_edges_per_frame=4", "start.whole_up_to=20",
)  # fmt: skip


@pytest.fixture(scope="module", autouse=True)
def short_blocks() -> Iterator[None]:
    """Two blocks of these sequences."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tracker, "FRAMES_IN_BLOCK", BLOCK)
        yield


def small_recipe(source: Path, *overrides: str) -> Recipe:
    return load_recipe("demo", [*SMALL, *overrides], source)


@pytest.fixture(scope="module")
def sequence(tmp_path_factory: pytest.TempPathFactory) -> Path:
    options = DemoOptions(frames=FRAMES, width=160, height=120, stride=1, turns=0.12)
    return make_sequence(tmp_path_factory.mktemp("long") / "sequence", options)


@pytest.fixture(scope="module")
def run(sequence: Path, tmp_path_factory: pytest.TempPathFactory) -> hodge_pipeline.Run:
    return hodge_pipeline.run(small_recipe(sequence, FUSED), tmp_path_factory.mktemp("runs") / "run")


@pytest.fixture(scope="module")
def whole(sequence: Path, tmp_path_factory: pytest.TempPathFactory) -> Tracked:
    """The sequence tracked as it is."""
    return track(TumReader().open(sequence), tmp_path_factory.mktemp("whole") / "t")[0]


def tracking_options(recipe: Recipe) -> TrackingOptions:
    assert isinstance(recipe.start, KeyFrameStart)
    return recipe.start._tracking(recipe.clouds)


def track(source: Source, folder: Path, readout: Readout | None = None) -> tuple[Tracked, list[str]]:
    """The sequence tracked, and the notes; its read-out, which is a third of the cost to estimate, is given."""
    folder.mkdir()
    options, notes = tracking_options(small_recipe(source.path)), list[str]()

    def tell(*told: Note) -> None:
        notes.extend(map(str, told))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tracked, "estimate_readout", lambda *_: readout)
        return tracked.track(source, options, workers=InProcess(), step=Step(folder, no_progress, tell)), notes


def all_poses(source: Source, found: Tracked, world_from_key: Floats) -> Floats:
    return followers(source, found).expand(world_from_key)


def empty_depth(shape: tuple[int, int]) -> Floats32:
    return np.zeros(shape, np.float32)


def with_dark(source: Source, rows: range, *, images: bool, depth: bool = True) -> Source:
    """Frames `rows` without `depth`, and black where their `images` went dark."""
    frames = list(source.frames)
    for row in rows:
        if depth:
            frames[row] = replace(frames[row], read_depth=partial(empty_depth, (120, 160)))
        if images:
            frames[row] = replace(frames[row], read_colour=partial(np.zeros, (120, 160, 3), np.uint8))
    return replace(source, frames=tuple(frames))


def exposed(frame: Frame, share: float) -> Frame:
    """The frame, its image so much brighter or darker."""
    read = frame.read_colour
    assert read is not None
    return replace(frame, read_colour=lambda: np.clip(read() * share, 0, 255).astype(np.uint8))


def test_key_frames_are_registered_and_every_frame_gets_a_pose(run: hodge_pipeline.Run) -> None:
    assert 2 < len(run.result.world_from_cam) < FRAMES / 2
    poses = parse_tum(run.folder / "poses.tum").trajectory
    assert len(poses) == FRAMES
    assert any("of 64 frames are key frames" in str(note) for note in run.report.notes)
    keys = len(run.result.world_from_cam)
    assert run.report.source.counted == f"64 frames, {keys} of them key frames"
    assert f"64 frames, {keys} of them key frames" in (run.folder / "report.html").read_text("utf-8")
    rows = {row.name: row for row in run.report.trajectories}
    assert rows["result"].frames == FRAMES
    assert rows["result"].ate_rmse_m < 0.02


@pytest.mark.parametrize("repose", [False, True])
def test_tracked_steps_stand_in_every_round_where_surfaces_register_pairs(
    sequence: Path, tmp_path: Path, repose: bool
) -> None:
    recipe = small_recipe(sequence, f"start.repose={str(repose).lower()}", "outer_iterations=2")
    first, *_, last = hodge_pipeline.run(recipe, tmp_path / "run").rounds
    steps = {tuple(pair): motion for pair, motion in zip(first.edges.pairs.tolist(), first.edges.i_from_j, strict=True)}
    pairs = [(row, steps[tuple(pair)]) for row, pair in enumerate(last.edges.pairs.tolist()) if tuple(pair) in steps]
    assert len(pairs) > 2 and len(last.edges.pairs) > len(pairs), "some steps, and some pairs that are none"
    assert all(np.array_equal(last.edges.i_from_j[row], motion) != repose for row, motion in pairs)


def test_every_frame_that_was_found_is_fused(run: hodge_pipeline.Run) -> None:
    found = np.arange(FRAMES) != 5
    keys = replace(run.key_frames, found=found)
    scene = Scene(run.source, key_source(run.source, keys.rows), keys, run.clouds, run.rounds[0])
    steps = Told(Path("cloud.ply"))
    fuse_all((CloudFuser(),), scene, run.poses, steps)  # type: ignore[arg-type]
    ((_, _, source, poses),) = steps.asked
    assert len(source.frames) == FRAMES
    np.testing.assert_array_equal(np.isfinite(poses).all((1, 2)), found)


def test_after_an_edit_key_frames_alone_are_fused_and_it_is_said(
    run: hodge_pipeline.Run, sequence: Path, tmp_path: Path
) -> None:
    folder, keys = Path(shutil.copytree(run.folder, tmp_path / "run")), len(run.result.world_from_cam)
    i, j = run.result.graph.vertex_ids[run.result.graph.edges[0]]
    write_history(folder / "edits.json", History((Edit(disable=(f"{i}-{j}",)),)))
    edited = solve_again(folder)
    assert any(f"the {keys} key frames alone" in str(note) for note in edited.report.notes)
    again = hodge_pipeline.run(small_recipe(sequence, FUSED), folder)
    assert not any("key frames alone" in str(note) for note in again.report.notes)
    np.testing.assert_array_equal(again.result.world_from_cam, edited.result.world_from_cam)


def test_frames_follow_their_key_frames(sequence: Path, whole: Tracked) -> None:
    source, found = TumReader().open(sequence), whole
    before = all_poses(source, found, found.world_from_key)
    np.testing.assert_allclose(before[found.key_rows], found.world_from_key, atol=1e-12)
    change = se3.exp(np.array([0.3, -0.2, 0.1, 1.0, 2.0, -0.5]))
    np.testing.assert_allclose(all_poses(source, found, change @ found.world_from_key), change @ before, atol=1e-9)
    assert found.found.all()
    assert (found.anchors[found.key_rows] == np.arange(len(found.key_rows))).all()


def test_blocks_share_their_border_and_nothing_else() -> None:
    rows = np.arange(10, 10 + 2 * BLOCK + 5)
    blocks = frame_blocks(rows, tuple(range(200)), np.arange(200.0))  # type: ignore[arg-type]
    own = [block.rows[int(block.warm_up) :] for block in blocks]
    assert [int(part[0]) for part in own[1:]] == [int(part[-1]) for part in own[:-1]]
    np.testing.assert_array_equal(np.concatenate([own[0], *(part[1:] for part in own[1:])]), rows)
    assert [block.rows.tolist() for block in frame_blocks(np.array([3]), tuple(range(9)), np.arange(9.0))] == [[3]]  # type: ignore[arg-type]


def test_frames_that_repeat_the_images_before_are_said_and_posed_by_their_neighbours(
    sequence: Path, tmp_path: Path
) -> None:
    source = TumReader().open(sequence)
    repeats = [*range(40, 44), 55]
    frames = list(source.frames)
    for row in repeats:
        shown = frames[row - 1]
        frames[row] = replace(
            frames[row], read_depth=shown.read_depth, read_colour=shown.read_colour, image=shown.image
        )
    stalled = replace(source, frames=tuple(frames))
    found, notes = track(stalled, tmp_path / "stalled")
    (said,) = [note for note in notes if "repeat the images" in note]
    assert said.startswith("5 frames repeat the images of the frame before (40–43, 55)")
    assert np.flatnonzero(~found.found).tolist() == repeats and not np.isin(found.key_rows, repeats).any()
    poses = all_poses(stalled, found, found.world_from_key)
    stamps = [frame.stamp_s for frame in frames]
    share = (stamps[55] - stamps[54]) / (stamps[56] - stamps[54])
    np.testing.assert_allclose(poses[55], se3.interpolate(poses[54], poses[56], np.array(share)), atol=1e-9)
    kept = np.setdiff1d(np.arange(len(frames)), repeats)
    alone, _ = track(replace(source, frames=tuple(source.frames[row] for row in kept)), tmp_path / "alone")
    np.testing.assert_array_equal(found.key_from_frame[kept], alone.key_from_frame)


@pytest.mark.parametrize("blank", [range(0, 3), range(46, 51)])
def test_frames_with_depth_and_a_black_image_are_said(sequence: Path, tmp_path: Path, blank: range) -> None:
    """Of several blocks each is counted once, and those without depth, or darker and brighter ones, are not; those that
    cannot be read are said with the reason.
    """
    source = with_dark(TumReader().open(sequence), blank, images=True, depth=False)
    frames = list(with_dark(source, range(30, 33), images=True).frames)
    frames[35], frames[55] = exposed(frames[35], 0.1), exposed(frames[55], 4.0)

    def unreadable() -> NoReturn:
        raise SourceError(f"{source.path}/rgb/20.png: the image is truncated")

    frames[20], frames[47] = (replace(frames[row], read_colour=unreadable) for row in (20, BLOCK - 1))
    _, notes = track(replace(source, frames=tuple(frames)), tmp_path / "blank")
    (said,) = [note for note in notes if "shows nothing" in note]
    blank_rows = np.setdiff1d(blank, [BLOCK - 1])
    assert said.startswith(f"{len(blank_rows)} frames have depth")
    assert f"({in_runs(blank_rows, np.arange(FRAMES))})" in said
    (said,) = [note for note in notes if "cannot be read" in note]
    assert said == "2 frames have images that cannot be read (20, 47), such as rgb/20.png: the image is truncated"


def test_frames_that_clouds_place_move_with_their_key_frame_where_flow_goes_on(sequence: Path, tmp_path: Path) -> None:
    """Key frame, black frames, key frame that flow sees from the first: what that one is off is none of theirs."""
    source = with_dark(TumReader().open(sequence), range(26, 29), images=True, depth=False)
    found, _ = track(source, tmp_path / "black")
    np.testing.assert_array_equal(found.apart, range(26, 29))
    moved = se3.exp(np.outer(np.arange(len(found.key_rows)), [0, 0.01, 0, 0.02, 0, 0.01]))
    before, keys = all_poses(source, found, found.world_from_key), moved @ found.world_from_key
    after = all_poses(source, found, keys)
    key = found.anchors[found.apart]
    np.testing.assert_allclose(
        se3.inverse(keys[key]) @ after[found.apart],
        se3.inverse(found.world_from_key[key]) @ before[found.apart],
        atol=1e-12,
    )
    others = np.setdiff1d(np.arange(FRAMES), np.concatenate([found.apart, found.key_rows]))
    rigid = keys[found.anchors] @ found.key_from_frame
    assert not np.allclose(after[others], rigid[others], atol=1e-3), "their change is interpolated"


def test_black_frames_of_a_kinect_end_no_worse_than_odometry(data_dir: Path, tmp_path: Path) -> None:
    path = data_dir / "tum" / "rgbd_dataset_freiburg1_xyz_60"
    recipe = load_recipe(
        "tum", ["executor.workers=0", "recording.level=off", "evaluation.tables=false", "fusion=[]"], path
    )
    frames = list(TumReader().open(path).frames[15:45])
    for row in range(10, 20):
        frames[row] = replace(frames[row], read_colour=partial(np.zeros, (480, 640, 3), np.uint8))
    source = replace(TumReader().open(path), frames=tuple(frames))
    rows = {row.name: row for row in hodge_pipeline.run(recipe, tmp_path / "run", source=source).report.trajectories}
    assert rows["result"].ate_rmse_m < 0.75 * rows["odometry"].ate_rmse_m
    assert rows["result"].ate_max_m < rows["odometry"].ate_max_m


def test_a_sequence_without_any_depth_in_range_is_an_error(sequence: Path, tmp_path: Path) -> None:
    source = with_dark(TumReader().open(sequence), range(FRAMES), images=False)
    with pytest.raises(
        SourceError, match=f"none of the {FRAMES} frames gave a point cloud: hodge inspect .* the first: "
    ):
        track(source, tmp_path / "dark")


@pytest.mark.parametrize(
    ("dark", "images"),
    [(range(20, 26), True), (range(46, 51), False), (range(46, 51), True), (range(60, 64), False)],
)
def test_frames_without_depth_are_bridged_and_said(
    sequence: Path, whole: Tracked, tmp_path: Path, dark: range, images: bool
) -> None:
    """A frame whose image alone is left may still be placed by it; a black one is lost."""
    source = TumReader().open(sequence)
    found, notes = track(with_dark(source, dark, images=images), tmp_path / "dark")
    lost = np.flatnonzero(~found.found).tolist()
    assert lost == list(dark) if images else set(lost) < set(dark)
    assert any(f"tracking was lost at {len(lost)} frames" in note for note in notes) == bool(lost)
    assert not any("for good" in note for note in notes)
    poses, expected = (all_poses(source, one, one.world_from_key) for one in (found, whole))
    seen = found.found
    first = int(np.flatnonzero(seen)[0])
    apart = se3.inverse(se3.inverse(poses[first]) @ poses) @ (se3.inverse(expected[first]) @ expected)
    assert np.linalg.norm(apart[seen, :3, 3], axis=1).max() < 0.06
    assert np.isfinite(poses).all()
    empty = set(found.key_rows[np.diff(found.clouds.offsets) == 0].tolist())
    assert empty <= {0, BLOCK, FRAMES - 1}  # the ends of blocks are key frames whatever they saw
    inside = [row for row in dark if dark[0] > 0 and dark[-1] < FRAMES - 1]
    assert all(np.linalg.norm(apart[row, :3, 3]) < 0.09 for row in inside)


@pytest.mark.parametrize("earlier", [False, True])
def test_a_killed_tracking_keeps_its_blocks(
    sequence: Path, tmp_path: Path, run: hodge_pipeline.Run, monkeypatch: pytest.MonkeyPatch, earlier: bool
) -> None:
    """But for one that an `earlier` version wrote with fewer columns, which is tracked again."""
    keep, written = TrackedBlocks.write, list[int]()

    def write(self: TrackedBlocks, number: int, block: object) -> None:
        keep(self, number, block)  # type: ignore[arg-type]
        written.append(number)
        if len(written) == 1:
            raise KeyboardInterrupt

    monkeypatch.setattr(TrackedBlocks, "write", write)
    folder, after = tmp_path / "run", Log(stop_at="registration, round 1")
    with pytest.raises(KeyboardInterrupt):
        hodge_pipeline.run(small_recipe(sequence), folder)
    if earlier:
        (block,) = folder.rglob("blocks/000000.npz")
        with np.load(block) as columns:
            np.savez(block, **{name: columns[name] for name in columns.files if name != "apart"})
    with pytest.raises(KeyboardInterrupt):
        hodge_pipeline.run(small_recipe(sequence), folder, watcher=after)
    assert written == ([0, 0, 1] if earlier else [0, 1]) and after.stages[-1] == after.stop_at
    assert not (folder / "stages/track-1/blocks").exists()
    (found,), (expected,) = (stored(path / "stages", tracked.track) for path in (folder, run.folder))
    np.testing.assert_array_equal(found.world_from_key, expected.world_from_key)
    np.testing.assert_array_equal(found.clouds.points, expected.clouds.points)


def test_clouds_are_joined_without_the_border_twice(sequence: Path, whole: Tracked) -> None:
    source, clouds = TumReader().open(sequence), whole.clouds
    assert len(clouds) == len(whole.key_rows) == len(set(whole.key_rows.tolist()))
    options = tracking_options(small_recipe(sequence))
    (first, *_) = frame_blocks(np.arange(FRAMES), tuple(source.frames), tracked.stamps_of(source))
    block = track_block(options, first)
    np.testing.assert_array_equal(clouds[1].points_in_cam, block.clouds[1].points_in_cam)


def test_the_same_command_again_computes_nothing(
    run: hodge_pipeline.Run, sequence: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "again"
    shutil.copytree(run.folder, folder)
    monkeypatch.setattr(tracked, "_track_missing", None)
    again = hodge_pipeline.run(small_recipe(sequence, FUSED), folder)
    np.testing.assert_array_equal(again.result.world_from_cam, run.result.world_from_cam)
    stages = [stage["name"] for stage in json.loads((folder / "report.json").read_text())["stages"]]
    assert "tracking" in stages


def test_a_recording_that_stops_for_an_hour_goes_on_where_the_camera_stayed(
    sequence: Path, whole: Tracked, tmp_path: Path
) -> None:
    source = TumReader().open(sequence)
    frames = [replace(frame, stamp_s=frame.stamp_s + 3600.0 * (row >= 30)) for row, frame in enumerate(source.frames)]
    found, notes = track(replace(source, frames=tuple(frames)), tmp_path / "stopped")
    assert found.found.all()
    assert any("the recording stops for 3600.0 s before 30:" in note for note in notes)
    poses, expected = (all_poses(source, one, one.world_from_key) for one in (found, whole))
    assert np.abs(poses - expected).max() < 0.06


def test_a_cut_in_a_recording_whose_stamps_go_on_joins_nothing(sequence: Path, tmp_path: Path) -> None:
    """Clouds of 45 degrees apart fit somewhere, metres off; flow from there finds nothing."""
    source, rows = TumReader().open(sequence), (3, 4, 28, 29)
    frames = [replace(source.frames[row], stamp_s=source.frames[place].stamp_s) for place, row in enumerate(rows)]
    found, notes = track(replace(source, frames=tuple(frames)), tmp_path / "cut")
    is_behind = found.key_rows >= 2
    assert is_behind.any() and not np.diff(is_behind[found.steps.pairs], axis=1).any()
    assert any("tracking was lost" in note for note in notes)


def test_a_clock_that_goes_back_is_said_and_costs_no_frame(sequence: Path, whole: Tracked, tmp_path: Path) -> None:
    source = TumReader().open(sequence)
    frames = [replace(frame, stamp_s=frame.stamp_s - 5.0 * (row >= 30)) for row, frame in enumerate(source.frames)]
    found, notes = track(replace(source, frames=tuple(frames)), tmp_path / "back")
    assert found.found.all()
    assert any("the clock goes back at 30:" in note for note in notes)
    poses, expected = (all_poses(source, one, one.world_from_key) for one in (found, whole))
    assert np.abs(poses - expected).max() < 0.06


def test_an_estimated_read_out_is_told_and_used_by_the_frames(
    sequence: Path, whole: Tracked, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source, none = TumReader().open(sequence), whole
    used = list[float]()

    def focal(*given: Any) -> Focal:
        used.append(given[4])
        return Focal(525.0, 610.4, 600.0, 620.0)

    monkeypatch.setattr(tracked, "estimate_focal", focal)
    found, notes = track(source, tmp_path / "found", Readout(0.022, 0.02, 0.0239))
    assert used == [0.022] and any("610 pixels (600 to 620) better than its 525" in note for note in notes)
    assert none.readout_s is None and followers(source, found).readout_s == 0.022
    assert any("estimated: 22 ms (20 to 24)" in note for note in notes)
    step, poses = Step(tmp_path, no_progress, lambda *_: None), all_poses(source, none, none.world_from_key)
    posed = [
        pose_frames(source, followers(source, one), one.sightings, poses, 1.0, workers=InProcess(), step=step)
        for one in (none, found)
    ]
    assert 0.001 < np.abs(posed[1] - posed[0]).max() < 0.1
