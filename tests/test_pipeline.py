"""The main job on a small rendered sequence: what a run leaves, resume after a kill, bad input."""

import csv
import json
import os
import shutil
import signal
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import hodge_pipeline
from fresh_process import run_fresh
from hodge_adapters.trajectories.text import parse_tum
from hodge_pipeline.demo.sequence import DemoOptions, make_sequence
from hodge_pipeline.errors import HodgeError, RecipeError, SourceError, WorkspaceError
from hodge_pipeline.recipe.schema import Recipe, load_recipe
from hodge_pipeline.registration import register
from hodge_pipeline.run_folder import Run
from hodge_pipeline.store import store
from stand_ins import Log
from synthetic import tiny_sequence  # noqa: F401 - a fixture

SMALL = (
    "clouds.voxel_m=0.1", "fusion=[{stage: cloud}]", "executor.workers=0", "recording.level=summary",
    "edges.max_edges_per_frame=4", "evaluation.tables=false",
)  # fmt: skip

SHORT = "acceptance.min_fitness=0.05", "start.min_fitness=0.05"


def small_recipe(source: Path, *overrides: str) -> Recipe:
    return load_recipe("demo", [*SMALL, *overrides], source)


@pytest.fixture(scope="module")
def short(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """A run of eight frames, for what begins again and again."""
    folder = tmp_path_factory.mktemp("short")
    source = make_sequence(folder / "source", DemoOptions(frames=8, width=80, height=60, turns=0.03))
    return hodge_pipeline.run(short_recipe(source), folder / "run")


def short_recipe(source: Path, *overrides: str) -> Recipe:
    return small_recipe(source, *SHORT, *overrides)


@pytest.fixture(scope="module")
def run(tiny_sequence: Path, tmp_path_factory: pytest.TempPathFactory) -> Run:  # noqa: F811
    return hodge_pipeline.run(small_recipe(tiny_sequence), tmp_path_factory.mktemp("runs") / "tiny")


def test_a_run_leaves_what_a_person_can_open(run: Run) -> None:
    names = {path.name for path in run.folder.iterdir()}
    expected = {"recipe.yaml", "poses.tum", "poses.kitti", "graph.g2o", "edges.csv", "report.html", "report.json"}
    assert names >= expected | {"cloud.ply", "recording.rrd", "log.txt"}
    report = json.loads((run.folder / "report.json").read_text())
    assert report["source"]["frames"] == 24
    np.testing.assert_array_equal(parse_tum(run.folder / "poses.tum").trajectory.world_from_cam[:, :3, 3],
                                  run.result.world_from_cam[:, :3, 3])  # fmt: skip


def test_the_result_is_near_the_truth(run: Run) -> None:
    rows = {row.name: row for row in run.report.trajectories}
    assert rows["result"].ate_rmse_m < 0.03
    assert rows["result"].ate_rmse_m <= rows["odometry"].ate_rmse_m + 0.002


def test_every_edge_has_a_verdict_in_the_table_and_the_report(run: Run) -> None:
    edges = run.result.graph_edges
    with (run.folder / "edges.csv").open() as file:
        rows = [row for row in csv.DictReader(file) if row["status"] != "rejected"]
    assert [row["verdict"] for row in rows] == edges.verdict.tolist()
    assert [row["probability"] == "" for row in rows] == np.isnan(edges.probability).tolist()
    assert all(row["why"] for row in rows)
    counts = json.loads((run.folder / "report.json").read_text())["graph"]["verdicts"]
    assert sum(counts.values()) == len(rows)
    assert counts["consistent"] == (edges.verdict == "consistent").sum() > 0.9 * len(rows)


def test_the_solve_converges_and_weighs_every_kept_edge(run: Run) -> None:
    solution, edges = run.result.solution, run.result.graph_edges
    assert solution is not None and solution.converged
    kept = ~np.isin(edges.verdict, ("wrong", "suspect"))
    np.testing.assert_array_equal(solution.weights > 0, kept)
    assert solution.weights[kept].min() < 0.9 < np.median(solution.weights)


def test_the_same_command_again_computes_nothing(run: Run) -> None:
    assert run.source.path is not None
    log = Log()
    again = hodge_pipeline.run(small_recipe(run.source.path), run.folder, watcher=log)
    assert log.stages == []
    np.testing.assert_array_equal(again.result.world_from_cam, run.result.world_from_cam)


def test_another_run_gives_the_same_poses_on_any_number_of_workers(short: Run, tmp_path: Path) -> None:
    recipe = short_recipe(short.source.path, "executor.workers=2", "recording.level=off")
    other = hodge_pipeline.run(recipe, tmp_path / "other")
    np.testing.assert_array_equal(other.result.world_from_cam, short.result.world_from_cam)


def test_a_run_that_was_stopped_again_and_again_goes_on_where_it_stopped(short: Run, tmp_path: Path) -> None:
    recipe, stopped, done = short_recipe(short.source.path), "", set[str]()
    for title in ("odometry", "solve, round 2", "recording", ""):
        log = Log(stop_at=title)
        with pytest.raises(KeyboardInterrupt) if title else nullcontext():
            resumed = hodge_pipeline.run(recipe, tmp_path / "run", watcher=log)
        assert stopped in ("", log.stages[0], "recording")
        assert not done & set(log.stages) - {"recording"}
        stopped, done = title, done.union(log.stages[: log.stages.index(title)] if title else ())
    np.testing.assert_array_equal(resumed.result.world_from_cam, short.result.world_from_cam)


def killed_after_a_block(source: Path, out: Path) -> None:
    keep = register.keep_block

    def keep_and_die(*block: Any) -> None:
        keep(*block)
        os.kill(os.getpid(), signal.SIGKILL)

    register.keep_block = keep_and_die
    hodge_pipeline.run(short_recipe(source, "recording.level=off"), out)


def test_a_killed_registration_keeps_its_blocks(short: Run, tmp_path: Path) -> None:
    killed = run_fresh(killed_after_a_block, short.source.path, tmp_path / "run")
    assert killed.returncode == -signal.SIGKILL, killed.stderr
    assert len(list((tmp_path / "run/stages/register_edges-1.part/blocks").glob("*.npz"))) == 1
    resumed = hodge_pipeline.run(short_recipe(short.source.path, "recording.level=off"), tmp_path / "run")
    np.testing.assert_array_equal(resumed.result.world_from_cam, short.result.world_from_cam)


def killed_at_a_step(source: Path, out: Path, when: str) -> None:
    left, commit = [8], store._commit

    def commit_and_die(part: Path, path: Path) -> None:
        left[0] -= 1
        if left[0] or when == "after":
            commit(part, path)
        if not left[0]:
            os.kill(os.getpid(), signal.SIGKILL)

    store._commit = commit_and_die
    hodge_pipeline.run(short_recipe(source, "recording.level=off"), out)


def test_a_run_that_is_killed_again_and_again_ends_with_the_same_poses(short: Run, tmp_path: Path) -> None:
    """Killed while its eighth step, from where it went on, gets its name: in turn just before and just after."""
    folder = tmp_path / "run"
    for when, finished in (("before", 7), ("after", 15)):
        killed = run_fresh(killed_at_a_step, short.source.path, folder, when)
        assert killed.returncode == -signal.SIGKILL, killed.stderr
        named = [path for path in folder.glob("stages/*/step.json") if path.parent.suffix != ".part"]
        assert len(named) == finished, "every start goes on where the last one ended"
    hodge_pipeline.run(short_recipe(short.source.path, "recording.level=off"), folder)
    found = Run.load(folder)
    np.testing.assert_array_equal(found.poses, short.poses)
    np.testing.assert_array_equal(found.edges.i_from_j, short.edges.i_from_j)
    assert not [path for path in folder.rglob("*") if path.suffix in (".part", ".draft")]


def test_a_later_stage_alone_is_repeated_when_its_option_changes(short: Run, tmp_path: Path) -> None:
    folder, log = tmp_path / "copy", Log()
    shutil.copytree(short.folder, folder)
    recipe = short_recipe(short.source.path, "fusion=[{stage: cloud, voxel_m: 0.05}]")
    with pytest.raises(WorkspaceError, match="--overwrite"):
        hodge_pipeline.run(recipe, folder)
    hodge_pipeline.run(recipe, folder, overwrite=True, watcher=log)
    assert log.stages == ["fusion 1", "recording", "recording", "report"]  # the model's part, and all parts as one


@pytest.fixture
def damaged(tiny_sequence: Path, tmp_path: Path) -> Path:  # noqa: F811
    folder = tmp_path / "sequence"
    shutil.copytree(tiny_sequence, folder)
    return folder


@pytest.fixture
def damaged_short(short: Run, tmp_path: Path) -> Path:
    folder = tmp_path / "sequence"
    shutil.copytree(short.source.path, folder)
    return folder


def quick(source: Path, out: Path, *overrides: str) -> Run:
    off = ("recording.level=off", "outer_iterations=1")
    return hodge_pipeline.run(small_recipe(source, *off, *overrides), out)


def test_unreadable_and_empty_frames_are_kept_without_edges_and_reported(damaged: Path, tmp_path: Path) -> None:
    depths = sorted((damaged / "depth").iterdir())
    depths[5].write_bytes(depths[5].read_bytes()[:2000])
    depths[9].unlink()
    cv2.imwrite(str(depths[12]), np.zeros((120, 160), np.uint16))
    cv2.imwrite(str(depths[16]), np.full((60, 80), 9000, np.uint16))
    result = quick(damaged, tmp_path / "run")
    bad = {5, 11, 15}  # the rows after the missing image move up by one
    notes = "\n".join(map(str, result.report.notes))
    assert f"1 depth images listed but not there left out: {depths[9].name}" in notes
    for row in bad:
        assert f"frame {result.source.frames[row].frame_id}" in notes
    assert not bad & set(result.result.graph.edges.ravel().tolist())
    assert len(parse_tum(tmp_path / "run/poses.tum").trajectory) == 23
    good = sorted(set(range(23)) - bad)
    steps = np.linalg.norm(np.diff(result.result.world_from_cam[good, :3, 3], axis=0), axis=1)
    assert steps.max() < 0.3


def test_a_sequence_in_two_pieces_is_a_warning_that_lists_them(damaged_short: Path, tmp_path: Path) -> None:
    for number, path in enumerate(sorted((damaged_short / "depth").iterdir())):
        if number >= 4:
            depth = np.random.default_rng(number).integers(4000, 20000, (60, 80), np.uint16)
            depth[:, 16:] = 0
            cv2.imwrite(str(path), depth)
    result = quick(damaged_short, tmp_path / "run", *SHORT)
    assert result.result.solution is not None
    assert result.result.solution.component.max() >= 1
    assert any("piece" in str(note) for note in result.report.notes)


def test_one_frame(damaged: Path, tmp_path: Path) -> None:
    first = sorted((damaged / "depth").iterdir())[0]
    for path in sorted((damaged / "depth").iterdir())[1:]:
        path.unlink()
    lines = [line for line in (damaged / "depth.txt").read_text().splitlines() if "#" in line or first.name in line]
    (damaged / "depth.txt").write_text("\n".join(lines) + "\n")
    result = quick(damaged, tmp_path / "run")
    assert len(result.result.world_from_cam) == 1
    assert any("single frame" in str(note) for note in result.report.notes)


def test_no_frame_with_depth_is_one_line(damaged_short: Path, tmp_path: Path) -> None:
    for path in (damaged_short / "depth").iterdir():
        cv2.imwrite(str(path), np.zeros((60, 80), np.uint16))
    with pytest.raises(SourceError, match="none of the 8 frames gave a point cloud"):
        quick(damaged_short, tmp_path / "run")


@pytest.mark.parametrize("make", ["missing", "empty folder"])
def test_a_source_that_is_none_is_one_line(tmp_path: Path, make: str) -> None:
    path = tmp_path / "source"
    if make == "empty folder":
        path.mkdir()
    with pytest.raises(HodgeError) as caught:
        quick(path, tmp_path / "run")
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_recipe_without_source_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(RecipeError, match="source"):
        hodge_pipeline.run("demo", tmp_path / "run")
