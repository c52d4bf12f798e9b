"""The recording of a run: part by part, readable however the run ends, made again without computing."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import textwrap
from pathlib import Path

import numpy as np
import pytest
from rerun.chunk import RrdReader

import hodge_pipeline
from hodge_pipeline.errors import HodgeError, SourceError, WorkspaceError
from hodge_pipeline.pipeline import Run
from hodge_pipeline.recording import binary, layout
from hodge_pipeline.replay import record_again
from synthetic import tiny_sequence  # noqa: F401 - a fixture
from test_pipeline import SMALL, Log, small_recipe
from test_recording import rows

NORMAL = ("executor.workers=0", "recording.level=normal", "evaluation.tables=false")


def verify(path: Path, scratch: Path) -> None:
    binary.run(["rrd", "verify", str(path)], binary.quiet_environment(scratch))


def entities(path: Path) -> set[str]:
    return {chunk.entity_path for chunk in RrdReader(path).stream().to_chunks()}


@pytest.fixture(scope="module")
def run(tiny_sequence: Path, tmp_path_factory: pytest.TempPathFactory) -> Run:  # noqa: F811
    return hodge_pipeline.run(small_recipe(tiny_sequence, *NORMAL), tmp_path_factory.mktemp("runs") / "tiny")


@pytest.mark.parametrize(
    ("title", "there", "missing"),
    [
        ("odometry", layout.CLOUD, layout.poses("odometry")),
        ("registration, round 2", layout.solved_edges(1), layout.edges(2)),
        ("fusion 1", layout.solved_edges(2), layout.MODEL),
    ],
)
def test_a_run_that_was_stopped_leaves_a_recording_of_what_was_done(
    run: Run,
    tmp_path: Path,
    title: str,
    there: str,
    missing: str,
) -> None:
    with pytest.raises(KeyboardInterrupt):
        hodge_pipeline.run(small_recipe(run.source.path, *NORMAL), tmp_path / "run", watcher=Log(stop_at=title))
    verify(tmp_path / "run/recording.rrd", tmp_path)
    found = entities(tmp_path / "run/recording.rrd")
    assert there in found and layout.COLOUR in found and layout.RECIPE in found
    assert missing not in found
    assert not list((tmp_path / "run").glob(".recording-*"))


def test_a_run_that_failed_leaves_a_recording_and_its_own_error(run: Run, tmp_path: Path) -> None:
    folder = tmp_path / "sequence"
    shutil.copytree(run.source.path, folder)
    for path in (folder / "depth").iterdir():
        path.write_bytes(b"no image")
    with pytest.raises(SourceError, match="none of the 24 frames"):
        hodge_pipeline.run(small_recipe(folder, *NORMAL), tmp_path / "run")
    assert layout.COLOUR in entities(tmp_path / "run/recording.rrd")


def stopped(run: Run, out: Path, signal_name: str) -> subprocess.CompletedProcess[str]:
    """A run from the command line that gets a signal after its first solve."""
    script = textwrap.dedent(f"""
        import os, signal, sys
        from hodge_pipeline import steps
        from hodge_pipeline.cli.main import main
        solve = steps.solve
        def solve_and_stop(job, number, *rest):
            if number == 2:
                os.kill(os.getpid(), signal.{signal_name})
            return solve(job, number, *rest)
        steps.solve = solve_and_stop
        sys.argv[1:] = ["run", "demo", "--source", {str(run.source.path)!r}, "--out", {str(out)!r}, "--quiet"]
        for change in {[*SMALL, *NORMAL]!r}:
            sys.argv += ["--set", change]
        main()
    """)
    return subprocess.run([sys.executable, "-c", script], check=False, capture_output=True, text=True)


@pytest.mark.skipif(os.name == "nt", reason="Windows has no such signals")
@pytest.mark.parametrize(("name", "code"), [("SIGINT", 130), ("SIGTERM", 143)])
def test_a_signal_ends_in_one_line_and_a_run_that_goes_on(run: Run, tmp_path: Path, name: str, code: int) -> None:
    ended = stopped(run, tmp_path / "run", name)
    assert ended.returncode == code
    assert ended.stderr.startswith("stopped: the same command goes on where it stopped; ")
    assert ended.stderr.count("\n") == 1
    verify(tmp_path / "run/recording.rrd", tmp_path)
    log = Log()
    resumed = hodge_pipeline.run(small_recipe(run.source.path, *NORMAL), tmp_path / "run", watcher=log)
    assert log.stages[0] == "solve, round 2"
    np.testing.assert_array_equal(resumed.result.world_from_cam, run.result.world_from_cam)


def test_a_killed_run_is_recorded_from_its_folder(run: Run, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    assert stopped(run, folder, "SIGKILL").returncode == -signal.SIGKILL
    assert not (folder / "recording.rrd").exists()
    parts = [str(path) for path in sorted((folder / "stages").glob("record-*/*.rrd"))]
    mended = str(tmp_path / "mended.rrd")
    merge = ["rrd", "merge", "--continue-on-error", *parts, "-o", mended]
    binary.run(merge, binary.quiet_environment(tmp_path))
    verify(Path(mended), tmp_path)
    path, missing = record_again(folder, {})
    assert missing == "solve, round 2"
    verify(path, tmp_path)
    assert layout.solved_edges(1) in entities(path) and layout.edges(2) not in entities(path)


def test_a_recording_made_again_computes_nothing(run: Run, tmp_path: Path) -> None:
    folder, log = tmp_path / "run", Log()
    shutil.copytree(run.folder, folder)
    before = {path: path.stat().st_mtime_ns for path in folder.rglob("*.npz")}
    path, missing = record_again(folder, {"level": "summary"}, log)
    assert missing == "" and set(log.stages) == {"recording"}
    assert layout.COLOUR not in entities(path) and layout.MODEL in entities(path)
    assert path.stat().st_size < (run.folder / "recording.rrd").stat().st_size
    assert {path: path.stat().st_mtime_ns for path in folder.rglob("*.npz")} == before
    again = Log()
    hodge_pipeline.run(small_recipe(run.source.path, *NORMAL), folder, watcher=again)  # back to the recipe's level
    assert set(again.stages) == {"recording"}
    assert layout.COLOUR in entities(folder / "recording.rrd")


def test_what_is_no_run_cannot_be_recorded(tmp_path: Path) -> None:
    with pytest.raises(WorkspaceError, match="is no run folder"):
        record_again(tmp_path, {})
    with pytest.raises(HodgeError):
        record_again(tmp_path / "nothing", {})


def test_the_parts_hold_what_the_run_holds(run: Run) -> None:
    path = run.folder / "recording.rrd"
    centres = np.squeeze(rows(path, layout.poses("round_2"), "Transform3D:translation"))
    np.testing.assert_array_equal(np.float32(centres), np.float32(run.result.world_from_cam[:, :3, 3]))
