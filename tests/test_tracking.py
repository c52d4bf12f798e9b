"""Long sequences: key frames, the poses of the frames between them, frames that show nothing, resume."""

import json
import shutil
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

import hodge_pipeline
from hodge_adapters.poses_text import parse_tum
from hodge_adapters.tum import TumReader
from hodge_pipeline import se3
from hodge_pipeline.demo.sequence import DemoOptions, make_sequence
from hodge_pipeline.executors.local import InProcess
from hodge_pipeline.pairs.edits import Edit, History, write_history
from hodge_pipeline.pipeline import solve_again
from hodge_pipeline.recipe.schema import Recipe, load_recipe
from hodge_pipeline.registration.tracked_blocks import TrackedBlocks
from hodge_pipeline.registration.tracking import FRAMES_IN_BLOCK, frame_blocks, track_block
from hodge_pipeline.scene import Round
from hodge_pipeline.start import first_poses as starting
from hodge_pipeline.start import key_frames as tracked
from hodge_pipeline.start.key_frames import Tracked, tracking_options
from hodge_pipeline.start.unordered.start import Start
from hodge_pipeline.types import CloudSet, Edges, Floats32, Frame, Source, ViewGraph

FRAMES = 64
SMALL = (
    "clouds.voxel_m=0.06", "fusion=[]", "executor.workers=0", "recording.level=off", "evaluation.tables=false",
    "outer_iterations=1", "edges.max_edges_per_frame=4", "key_frames.whole_up_to=20",
)  # fmt: skip


def small_recipe(source: Path, *overrides: str) -> Recipe:
    return load_recipe("demo", [*SMALL, *overrides], source)


@pytest.fixture(scope="module")
def sequence(tmp_path_factory: pytest.TempPathFactory) -> Path:
    options = DemoOptions(frames=FRAMES, width=160, height=120, stride=1, turns=0.12)
    return make_sequence(tmp_path_factory.mktemp("long") / "sequence", options)


@pytest.fixture(scope="module")
def run(sequence: Path, tmp_path_factory: pytest.TempPathFactory) -> hodge_pipeline.Run:
    return hodge_pipeline.run(small_recipe(sequence), tmp_path_factory.mktemp("runs") / "run")


def track(source: Source, folder: Path) -> tuple[Tracked, tuple[str, ...]]:
    folder.mkdir()
    options = tracking_options(small_recipe(source.path))
    return tracked._track(source, options, folder, InProcess(), lambda done: None)


def empty_depth(shape: tuple[int, int]) -> Floats32:
    return np.zeros(shape, np.float32)


def with_dark(source: Source, rows: range) -> Source:
    frames = list(source.frames)
    for row in rows:
        frames[row] = replace(frames[row], read_depth=partial(empty_depth, (120, 160)))
    return replace(source, frames=tuple(frames))


def test_key_frames_are_registered_and_every_frame_gets_a_pose(run: hodge_pipeline.Run) -> None:
    assert 2 < len(run.result.world_from_cam) < FRAMES / 2
    poses = parse_tum(run.folder / "poses.tum").trajectory
    assert len(poses) == FRAMES
    assert any("of 64 frames are key frames" in note for note in run.report.notes)
    keys = len(run.result.world_from_cam)
    assert run.report.source.counted == f"64 frames, {keys} of them key frames"
    assert f"64 frames, {keys} of them key frames" in (run.folder / "report.html").read_text("utf-8")
    rows = {row.name: row for row in run.report.trajectories}
    assert rows["result"].frames == FRAMES
    assert rows["result"].ate_rmse_m < 0.02


def test_every_frame_that_was_found_is_fused(run: hodge_pipeline.Run) -> None:
    assert run.tracked is not None
    job = hodge_pipeline.store.job.Job(small_recipe(run.folder), None, hodge_pipeline.store.progress.Nobody())  # type: ignore[arg-type]
    found = np.arange(FRAMES) != 5
    job.tracked = replace(run.tracked, found=found)
    frames, poses = tracked.frames_to_fuse(job, run.source, run.result)
    assert len(frames) == FRAMES
    np.testing.assert_array_equal(np.isfinite(poses).all((1, 2)), found)


def test_after_an_edit_key_frames_alone_are_fused_and_it_is_said(sequence: Path, tmp_path: Path) -> None:
    recipe = small_recipe(sequence, "fusion=[cloud]")
    before = hodge_pipeline.run(recipe, tmp_path / "run")
    keys = len(before.result.world_from_cam)
    i, j = before.result.graph.vertex_ids[before.result.graph.edges[0]]
    write_history(before.folder, History((Edit(disable=(f"{i}-{j}",)),)))
    edited = solve_again(before.folder)
    assert any(f"the {keys} key frames alone" in note for note in edited.report.notes)
    again = hodge_pipeline.run(recipe, before.folder)
    assert not any("key frames alone" in note for note in again.report.notes)
    np.testing.assert_array_equal(again.result.world_from_cam, edited.result.world_from_cam)


def test_a_source_that_is_short_enough_is_registered_whole(sequence: Path) -> None:
    recipe = small_recipe(sequence, "key_frames.whole_up_to=64")
    source = TumReader().open(sequence)
    job = hodge_pipeline.store.job.Job(recipe, None, hodge_pipeline.store.progress.Nobody())  # type: ignore[arg-type]
    assert tracked.key_frames(job, source) is source


def test_frames_follow_their_key_frames(sequence: Path, tmp_path: Path) -> None:
    found, _ = track(TumReader().open(sequence), tmp_path / "t")
    before = found.all_poses(found.world_from_key)
    np.testing.assert_allclose(before[found.key_rows], found.world_from_key, atol=1e-12)
    change = se3.exp(np.array([0.3, -0.2, 0.1, 1.0, 2.0, -0.5]))
    np.testing.assert_allclose(found.all_poses(change @ found.world_from_key), change @ before, atol=1e-9)
    assert found.found.all()
    assert (found.anchors[found.key_rows] == np.arange(len(found.key_rows))).all()


def test_blocks_share_their_border_and_nothing_else() -> None:
    rows = np.arange(10, 10 + 2 * FRAMES_IN_BLOCK + 5)
    blocks = frame_blocks(rows, tuple(range(200)), np.arange(200.0))  # type: ignore[arg-type]
    own = [block.rows[int(block.warm_up) :] for block in blocks]
    assert [int(part[0]) for part in own[1:]] == [int(part[-1]) for part in own[:-1]]
    np.testing.assert_array_equal(np.concatenate([own[0], *(part[1:] for part in own[1:])]), rows)
    assert [block.rows.tolist() for block in frame_blocks(np.array([3]), tuple(range(9)), np.arange(9.0))] == [[3]]  # type: ignore[arg-type]


@pytest.mark.parametrize("dark", [range(20, 26), range(46, 51), range(60, 64)])
def test_frames_without_depth_are_bridged_and_said(sequence: Path, tmp_path: Path, dark: range) -> None:
    source = TumReader().open(sequence)
    whole, _ = track(source, tmp_path / "whole")
    found, notes = track(with_dark(source, dark), tmp_path / "dark")
    assert np.flatnonzero(~found.found).tolist() == list(dark)
    assert any(f"tracking was lost at {len(dark)} frames" in note for note in notes)
    assert not any("for good" in note for note in notes)
    poses, expected = (one.all_poses(one.world_from_key) for one in (found, whole))
    seen = found.found
    first = int(np.flatnonzero(seen)[0])
    apart = se3.inverse(se3.inverse(poses[first]) @ poses) @ (se3.inverse(expected[first]) @ expected)
    assert np.linalg.norm(apart[seen, :3, 3], axis=1).max() < 0.06
    assert np.isfinite(poses).all()
    inside = [row for row in dark if dark[0] > 0 and dark[-1] < FRAMES - 1]
    assert all(np.linalg.norm(apart[row, :3, 3]) < 0.09 for row in inside)


@pytest.mark.parametrize(
    ("edges", "apart"),
    [([[0, 1], [1, 2], [2, 3]], False), ([[0, 1], [2, 3]], True), ([[0, 1], [1, 2]], False)],  # the last: a lone frame
)
def test_relocalisation_is_automatic_where_odometry_left_parts(edges: list[list[int]], apart: bool) -> None:
    graph = ViewGraph.from_edges(np.arange(4), np.array(edges), np.broadcast_to(np.eye(4), (len(edges), 4, 4)))
    assert (
        starting._apart(Round(Edges.measured(graph), graph.vertex_ids, np.broadcast_to(np.eye(4), (4, 4, 4)))) == apart
    )


def source_at(stamps_s: list[float]) -> Source:
    return Source("four", Path("four"), tuple(Frame(row, stamp_s) for row, stamp_s in enumerate(stamps_s)))


def test_parts_that_nothing_joins_stay_where_they_are_guessed_to_be_unless_over_a_hole() -> None:
    edges, poses = np.array([[0, 1], [2, 3]]), np.broadcast_to(np.eye(4), (4, 4, 4))
    graph = ViewGraph.from_edges(np.arange(4), edges, poses[:2])
    known = Round(Edges.measured(graph), graph.vertex_ids, poses)
    apart = Start(poses, graph, np.array([0, 0, 1, 1]), ())
    joined = Start(poses, graph, np.zeros(4, np.int64), ())
    steady, hole = source_at([0, 1, 2, 3]), source_at([0, 1, 2, 30])
    assert starting._stays(steady, known, apart)
    assert not starting._stays(steady, known, joined)
    assert not starting._stays(hole, known, apart)


def test_a_killed_tracking_keeps_its_blocks(
    sequence: Path, tmp_path: Path, run: hodge_pipeline.Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    keep, written = TrackedBlocks.write, list[int]()

    def write(self: TrackedBlocks, number: int, block: object) -> None:
        keep(self, number, block)  # type: ignore[arg-type]
        written.append(number)
        if len(written) == 1:
            raise KeyboardInterrupt

    monkeypatch.setattr(TrackedBlocks, "write", write)
    with pytest.raises(KeyboardInterrupt):
        hodge_pipeline.run(small_recipe(sequence), tmp_path / "run")
    again = hodge_pipeline.run(small_recipe(sequence), tmp_path / "run")
    assert written == [0, 1]
    np.testing.assert_array_equal(again.result.world_from_cam, run.result.world_from_cam)
    assert not (again.folder / "stages" / "clouds" / "blocks").exists()


def test_clouds_are_joined_without_the_border_twice(sequence: Path, tmp_path: Path) -> None:
    source = TumReader().open(sequence)
    found, _ = track(source, tmp_path / "t")
    clouds = CloudSet.open(tmp_path / "t")
    assert len(clouds) == len(found.key_rows) == len(set(found.key_rows.tolist()))
    options = tracking_options(small_recipe(sequence))
    (first, *_) = frame_blocks(np.arange(FRAMES), tuple(source.frames), tracked.stamps_of(source))
    block = track_block(options, first)
    np.testing.assert_array_equal(clouds[1].points_in_cam, block.clouds[1].points_in_cam)


def test_the_same_command_again_computes_nothing(
    run: hodge_pipeline.Run, sequence: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "again"
    shutil.copytree(run.folder, folder)
    monkeypatch.setattr(tracked, "_track", None)
    again = hodge_pipeline.run(small_recipe(sequence), folder)
    np.testing.assert_array_equal(again.result.world_from_cam, run.result.world_from_cam)
    stages = [stage["name"] for stage in json.loads((folder / "report.json").read_text())["stages"]]
    assert "tracking" in stages
