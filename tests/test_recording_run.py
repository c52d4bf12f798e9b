"""The recording of a run: part by part, readable however the run ends, made again without computing."""

from __future__ import annotations

import os
import shutil
import signal
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rerun.chunk import RrdReader

import hodge_pipeline
from fresh_process import run_fresh
from hodge_pipeline import se3
from hodge_pipeline.cli.main import main
from hodge_pipeline.errors import HodgeError, SourceError, WorkspaceError
from hodge_pipeline.recording import layout, live, shapes
from hodge_pipeline.registration.register import register_edges
from hodge_pipeline.rounds.one_round import Work
from hodge_pipeline.run_folder import Run
from hodge_pipeline.scene import Round
from hodge_pipeline.start.odometry import chain
from hodge_pipeline.store import store as store_module
from hodge_pipeline.store.store import stored
from hodge_pipeline.types.ply import read_model
from hodge_pipeline.uses.record_again import record_again
from recording_data import rgb, rows
from stand_ins import Log
from synthetic import short_sequence  # noqa: F401 - a fixture
from test_pipeline import SHORT, SMALL, short_recipe

NORMAL = ("recording.level=normal",)


def verify(path: Path, scratch: Path) -> None:
    live.run_program(["rrd", "verify", str(path)], live.quiet_environment(scratch))


def entities(path: Path) -> set[str]:
    return {chunk.entity_path for chunk in RrdReader(path).stream().to_chunks()}


@pytest.fixture(scope="module")
def run(short_sequence: Path, tmp_path_factory: pytest.TempPathFactory) -> Run:  # noqa: F811
    return hodge_pipeline.run(short_recipe(short_sequence, *NORMAL), tmp_path_factory.mktemp("runs") / "short")


def test_a_run_that_was_stopped_again_and_again_leaves_recordings_of_what_was_done(run: Run, tmp_path: Path) -> None:
    for title, there, missing in (
        ("odometry", layout.CLOUD, layout.poses("odometry")),
        ("registration, round 2", layout.solved_edges(1), layout.edges(2)),
        ("fusion 1", layout.solved_edges(2), layout.MODEL),
    ):
        with pytest.raises(KeyboardInterrupt):
            hodge_pipeline.run(short_recipe(run.source.path, *NORMAL), tmp_path / "run", watcher=Log(stop_at=title))
        verify(tmp_path / "run/recording.rrd", tmp_path)
        found = entities(tmp_path / "run/recording.rrd")
        assert there in found and layout.COLOUR in found and layout.RECIPE in found
        assert missing not in found
        assert not list((tmp_path / "run").glob(".recording-*"))


def test_a_run_that_failed_leaves_a_recording_and_its_own_error(run: Run, tmp_path: Path) -> None:
    folder = tmp_path / "sequence"
    shutil.copytree(run.source.path, folder)
    for path in (folder / "depth").iterdir():
        path.write_bytes(path.read_bytes()[:64])  # its header, which tells the size
    with pytest.raises(SourceError, match="none of the 8 frames"):
        hodge_pipeline.run(short_recipe(folder, *NORMAL), tmp_path / "run")
    assert layout.COLOUR in entities(tmp_path / "run/recording.rrd")


def stopped(source: Path, out: Path, number: signal.Signals) -> None:
    """A run from the command line that gets a signal after its first solve."""
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a job in the background of a script ignores it
    solve = Work.solve

    def solve_and_stop(work: Work, registered: Round, *rest: Any) -> Any:
        if registered.name == "round 2":
            os.kill(os.getpid(), number)
        return solve(work, registered, *rest)

    Work.solve = solve_and_stop  # type: ignore[method-assign]
    sets = [word for change in (*SMALL, *SHORT, *NORMAL) for word in ("--set", change)]
    sys.argv[1:] = ["run", "demo", "--source", str(source), "--out", str(out), "--quiet", *sets]
    main()


@pytest.mark.skipif(os.name == "nt", reason="Windows has no such signals")
@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_ends_in_one_line_and_a_run_that_goes_on(
    run: Run, tmp_path: Path, number: signal.Signals, code: int
) -> None:
    ended = run_fresh(stopped, run.source.path, tmp_path / "run", number)
    assert ended.returncode == code
    assert ended.stderr.startswith("stopped: the same command goes on where it stopped; ")
    assert ended.stderr.count("\n") == 1
    verify(tmp_path / "run/recording.rrd", tmp_path)
    log = Log()
    resumed = hodge_pipeline.run(short_recipe(run.source.path, *NORMAL), tmp_path / "run", watcher=log)
    assert log.stages[0] == "solve, round 2"
    np.testing.assert_array_equal(resumed.result.world_from_cam, run.result.world_from_cam)


def test_a_killed_run_is_recorded_from_its_folder(run: Run, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    assert run_fresh(stopped, run.source.path, folder, signal.SIGKILL).returncode == -signal.SIGKILL
    assert not (folder / "recording.rrd").exists()
    parts = [str(path) for path in sorted((folder / "stages").glob("record_*/*.rrd"))]
    mended = str(tmp_path / "mended.rrd")
    merge = ["rrd", "merge", "--continue-on-error", *parts, "-o", mended]
    live.run_program(merge, live.quiet_environment(tmp_path))
    verify(Path(mended), tmp_path)
    path, is_whole = record_again(folder, {})
    assert not is_whole
    verify(path, tmp_path)
    assert layout.solved_edges(1) in entities(path) and layout.edges(2) not in entities(path)


def test_a_recording_made_again_computes_nothing(run: Run, tmp_path: Path) -> None:
    folder, log = tmp_path / "run", Log()
    shutil.copytree(run.folder, folder)
    before = {path: path.stat().st_mtime_ns for path in folder.rglob("*.npz")}
    path, is_whole = record_again(folder, {"level": "summary"}, log)
    assert is_whole and set(log.stages) == {"recording"}
    assert layout.COLOUR not in entities(path) and layout.MODEL in entities(path)
    assert path.stat().st_size < (run.folder / "recording.rrd").stat().st_size
    assert {path: path.stat().st_mtime_ns for path in folder.rglob("*.npz")} == before
    again = Log()
    hodge_pipeline.run(short_recipe(run.source.path, *NORMAL), folder, watcher=again)  # back to the recipe's level
    assert again.stages == []
    assert layout.COLOUR in entities(folder / "recording.rrd")


def test_a_run_of_other_versions_or_of_a_source_that_is_gone_is_recorded_all_the_same(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, source = tmp_path / "run", tmp_path / "gone"
    shutil.copytree(run.folder, folder)
    recipe = folder / "recipe.yaml"
    recipe.write_text(recipe.read_text().replace(str(run.source.path), str(source)))
    monkeypatch.setattr(store_module, "versions", lambda: {"open3d": "0.1"})
    log = Log()
    path, is_whole = record_again(folder, {}, log)
    assert is_whole and any(f"without images: {source}" in said for said in log.said)
    found = entities(path)
    assert layout.COLOUR not in found and {layout.CLOUD, layout.MODEL, layout.solved_edges(2)} <= found


def test_a_run_with_a_changed_file_keeps_its_recording(run: Run, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    shutil.copytree(run.folder, folder)
    recorded = (folder / "recording.rrd").read_bytes()
    with (folder / "stages/solve_edges-1/value.npz").open("ab") as file:
        file.write(b"!")
    with pytest.raises(WorkspaceError, match=r"solve_edges-1: value.npz has changed .*: the same hodge run computes"):
        record_again(folder, {})
    assert (folder / "recording.rrd").read_bytes() == recorded


def test_what_is_no_run_cannot_be_recorded(tmp_path: Path) -> None:
    with pytest.raises(WorkspaceError, match="is no run folder"):
        record_again(tmp_path, {})
    with pytest.raises(HodgeError):
        record_again(tmp_path / "nothing", {})


def test_reader_and_odometry_read_back(run: Run) -> None:
    path, frames = run.folder / "recording.rrd", run.source.frames
    for entity, column, encoded in (
        (layout.COLOUR, "EncodedImage:blob", "encoded_colour"),
        (layout.DEPTH, "EncodedDepthImage:blob", "encoded_depth"),
    ):
        blobs = [bytes(row[0]) for row in rows(path, entity, column)]
        assert blobs == [getattr(frame, encoded)().contents for frame in frames]
    (odometry,) = (found.world_from_cam for found in stored(run.folder / "stages", chain))
    centres = np.squeeze(rows(path, layout.poses("odometry"), "Transform3D:translation"))
    np.testing.assert_array_equal(np.float32(centres), np.float32(odometry[:, :3, 3]))
    points = np.squeeze(rows(path, layout.under(layout.FRAME_PLOTS, "points"), "Scalars:scalars"))
    np.testing.assert_array_equal(points, run.clouds.sizes)


def test_registration_and_edges_read_back(run: Run) -> None:
    path = run.folder / "recording.rrd"
    registered = stored(run.folder / "stages", register_edges)[1]
    columns = layout.registration(2)
    np.testing.assert_array_equal(np.float32(rows(path, columns, "fitness")[0]), np.float32(registered.fitness))
    np.testing.assert_array_equal(np.float32(rows(path, columns, "rmse_m")[0]), np.float32(registered.rmse_m))
    assert rows(path, columns, "i")[0] == registered.pairs[:, 0].tolist()
    graph = run.result.graph
    before = run.rounds[1].world_from_cam
    (lines,) = rows(path, layout.edges(2), "LineStrips3D:strips")
    np.testing.assert_array_equal(np.float32(lines), np.float32(before[graph.edges, :3, 3]))
    (colours,) = rows(path, layout.edges(2), "LineStrips3D:colors")
    expected = shapes.residual_colours(shapes.residuals_m(graph, before), 0.05)
    np.testing.assert_array_equal(rgb(colours), expected)


def test_solver_reads_back_iteration_by_iteration(run: Run) -> None:
    path, solution = run.folder / "recording.rrd", run.result.solution
    assert solution is not None
    first = run.rounds[1].solution
    assert first is not None
    states = [step.world_from_cam for step in solution.history]
    film = dict(
        zip(
            rows(path, layout.FILM_TRAJECTORY, layout.ITERATION),
            [row for row in rows(path, layout.FILM_TRAJECTORY, "Points3D:positions") if row],
            strict=False,
        )
    )
    start = len(first.history) + 1  # the first round's start and iterations come before
    for step, state in enumerate(states, start=start + 1):
        np.testing.assert_array_equal(np.float32(film[step]), np.float32(state[:, :3, 3]))
    objective = layout.under(layout.SOLVER_PLOTS, "objective")
    recorded = np.squeeze(rows(path, objective, "Scalars:scalars"))
    expected = [step.objective for one in (first, solution) for step in one.history]
    np.testing.assert_array_equal(recorded, expected)
    centres = np.squeeze(rows(path, layout.poses("round_2"), "Transform3D:translation"))
    turns = np.squeeze(rows(path, layout.poses("round_2"), "Transform3D:quaternion"))
    np.testing.assert_array_equal(np.float32(centres), np.float32(run.result.world_from_cam[:, :3, 3]))
    np.testing.assert_array_equal(np.float32(turns), np.float32(se3.to_quat_xyzw(run.result.world_from_cam)))


def test_verdicts_model_and_errors_read_back(run: Run) -> None:
    path, edges = run.folder / "recording.rrd", run.result.graph_edges
    for name in np.unique(edges.verdict):
        (lines,) = rows(path, layout.verdict(str(name)), "LineStrips3D:strips")
        assert len(lines) == np.count_nonzero(edges.verdict == name)
    (points,) = rows(path, layout.MODEL, "Points3D:positions")
    np.testing.assert_array_equal(np.float32(points), read_model(run.folder / "cloud.ply").points_in_world)
    grown = sum(
        len(row)
        for step in range(24)
        for row in rows(path, layout.growth(step), "Points3D:positions")
        if row is not None
    )
    assert grown == len(points)
    errors = np.squeeze(rows(path, layout.under(layout.FRAME_PLOTS, "error_m/result"), "Scalars:scalars"))
    result = next(row for row in run.report.trajectories if row.name == "result")
    assert np.sqrt(np.mean(errors**2)) == pytest.approx(result.ate_rmse_m, rel=1e-6)
