"""The commands about recordings: `hodge view`, `hodge record`, `hodge compare`."""

from __future__ import annotations

import time
from contextlib import suppress
from pathlib import Path
from typing import Any, get_args

from hodge_pipeline.cli.console import ProgressBars, print_table
from hodge_pipeline.errors import RecipeError, WorkspaceError
from hodge_pipeline.recipe.recording_options import Level
from hodge_pipeline.store.workspace import RECORDING_FILE, is_run_folder
from hodge_pipeline.types.input_files import beginning

RRD_MAGIC = b"RR"
"""Recordings begin with RRF2, RRF1, RRF0 or RRIO."""


def record(run_folder: Path, level: str | None, max_megabytes: float | None, *, quiet: bool) -> None:
    """Make a run's recording again and say where it is."""
    levels = [name for name in get_args(Level) if name != "off"]
    if level is not None and level not in levels:
        raise RecipeError(f"--level {level}: expected {', '.join(levels)}")
    if max_megabytes is not None and not max_megabytes > 0:
        raise RecipeError(f"--max-megabytes {max_megabytes:g}: expected a size above zero")
    from hodge_pipeline.uses.record_again import record_again

    given: dict[str, Any] = {"level": level, "max_megabytes": max_megabytes}
    with ProgressBars(quiet) as terminal:
        path, is_whole = record_again(
            run_folder, {name: value for name, value in given.items() if value is not None}, terminal
        )
    if not quiet:
        print(f"{path}: {path.stat().st_size / 1e6:.1f} MB")
        if not is_whole:
            print("the run is not finished: it is recorded as far as it came")


def view(run_folder: Path, *, web: bool) -> None:
    """Open the recording in the viewer, or serve it on this machine, and wait until it is closed."""
    recording = _recording_of(run_folder)
    from hodge_pipeline.recording import live

    if web:
        with live.served([recording], opens_browser=True) as (_, page):
            print(f"{page}\nCtrl-C ends it", flush=True)
            with suppress(KeyboardInterrupt):
                while True:
                    time.sleep(3600)
    elif not live.has_screen():
        raise WorkspaceError(f"{recording}: there is no screen here: add --web")
    else:
        viewer = live.start([str(recording.resolve()), "--bind", live.HOST, "--port", "auto"])
        try:
            failed = viewer.wait()
        finally:
            viewer.kill()
        if failed:
            raise WorkspaceError(f"{recording}: the viewer ended with an error: try --web")


def _recording_of(path: Path) -> Path:
    """The recording of a run folder, or a file that is one."""
    if not path.exists():
        raise WorkspaceError(f"{path}: no recording here, and no run folder: it does not exist")
    if path.is_file():
        if beginning(path, len(RRD_MAGIC)) != RRD_MAGIC:
            raise WorkspaceError(f"{path}: no Rerun recording (.rrd): name a run folder, or its {RECORDING_FILE}")
        return path
    if not (recording := path / RECORDING_FILE).is_file():
        if not is_run_folder(path):
            raise WorkspaceError(f"{path}: no run folder: name the folder that `hodge run … --out` wrote")
        raise WorkspaceError(f"{recording}: no recording here: make one with `hodge record {path} --level normal`")
    return recording


def compare(first: Path, second: Path, out: Path | None) -> None:
    """Print two runs side by side, and write their comparison as a page and as a recording."""
    from hodge_pipeline.run_folder import Run
    from hodge_pipeline.uses.compared import compare as compare_runs
    from hodge_pipeline.uses.compared import tables, write_comparison

    comparison = compare_runs(Run.load(first), Run.load(second))
    folder = second if out is None else out
    written = write_comparison(folder, comparison)
    for table in tables(comparison):
        if table.rows:
            print_table(table.title, table.header, table.rows)
    for path in written:
        print(f"{'written':<8} {path}")
