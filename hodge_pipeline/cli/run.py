"""The commands that run a recipe: `hodge run`, `hodge demo`, `hodge refine trajectory`."""

from __future__ import annotations

import json
import signal
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from hodge_pipeline.cli.console import ProgressBars, print_json, print_table
from hodge_pipeline.cli.options import Shown
from hodge_pipeline.errors import CheckError, RecipeError, SourceError
from hodge_pipeline.recipe.schema import load_recipe
from hodge_pipeline.store.workspace import PAGE_FILE, RECORDING_FILE

if TYPE_CHECKING:
    from hodge_pipeline.run_folder import Run


def run(
    recipe: str,
    source: Path | None,
    out: Path,
    overrides: Sequence[str],
    shown: Shown,
    *,
    overwrite: bool,
    live: bool = False,
    dask: str | None = None,
    strict: bool = False,
) -> None:
    """Run a recipe and print what came out."""
    loaded = load_recipe(recipe, overrides, source)
    if loaded.source.path is None:
        raise RecipeError(f"recipe '{recipe}' names no source: add --source PATH")
    from hodge_pipeline.executors.dask import describe
    from hodge_pipeline.uses.recipe_run import run as run_pipeline

    with resumable(out), ProgressBars.of(shown) as terminal, _viewer(live, terminal) as address:
        if dask is not None:
            terminal.say(describe(dask))
        result = run_pipeline(
            loaded, out, overwrite=overwrite, watcher=terminal, live=address, dask=dask, strict=strict
        )
    print_result(result, shown)
    check_outcome(result)


def check_outcome(result: Run) -> None:
    """Raise `CheckError`, exit code 3, where the guard kept the poses given as better, or no two frames are joined."""
    report, refined = result.report, result.refined
    if refined is not None:
        if refined.decision.exit_code:
            raise CheckError(refined.decision.reason)
    elif report.graph is not None and report.graph.vertices > 1 and not report.pieces:
        of_all = f"of {report.graph.vertices} {report.source.vertex_name}"
        raise CheckError(f"no two {of_all} are joined: {result.folder / PAGE_FILE} says why")


def named_truth(truth: str | None) -> list[str]:
    """The option that `--truth` stands for."""
    return [] if truth is None else [f"evaluation.truth={json.dumps(truth)}"]


def print_result(result: Run, shown: Shown) -> None:
    """Print the report of a run: ten lines, with all tables and notes, or JSON."""
    if shown.as_json:
        from hodge_pipeline.report.write import as_json

        print_json(as_json(result.report))
    elif not shown.quiet:
        _print_summary(result, verbose=shown.verbose)


@contextmanager
def _viewer(live: bool, terminal: ProgressBars) -> Iterator[str | None]:
    """The address of a live viewer, where one is asked for; a line says where it is seen."""
    if not live:
        yield None
        return
    from hodge_pipeline.recording.live import viewer

    with viewer() as (address, where):
        terminal.say(f"live: {where}")
        yield address


class Terminated(KeyboardInterrupt):
    """SIGTERM: the system asks the process to end, as Ctrl-C does."""


def _terminate(*_: object) -> None:
    raise Terminated


@contextmanager
def resumable(out: Path) -> Iterator[None]:
    """Exit with one line on how a stopped run goes on: code 130 after Ctrl-C, 143 after SIGTERM."""
    before = signal.signal(signal.SIGTERM, _terminate)
    try:
        yield
    except KeyboardInterrupt as stop:
        recording = out / RECORDING_FILE
        shown = f"; {recording} shows what was done" if recording.is_file() else ""
        print(f"stopped: the same command goes on where it stopped{shown}", file=sys.stderr)
        raise typer.Exit(143 if isinstance(stop, Terminated) else 130) from stop
    finally:
        signal.signal(signal.SIGTERM, before)


def demo(
    out: Path,
    overrides: Sequence[str],
    shown: Shown,
    *,
    lidar: bool,
    rooms: int,
    video: bool,
    overwrite: bool,
    dask: str | None,
) -> None:
    """Make the demo's room, building or street, or find it in the cache, and run `demo`, `tum` or `lidar` on it."""
    from hodge_pipeline.demo.sequence import BuildingOptions, DemoOptions, World, demo_source
    from hodge_pipeline.demo.sweeps import TRUTH_FILE, StreetOptions

    room: World = DemoOptions.video() if video else DemoOptions()
    indoors: World = room if rooms == 1 else BuildingOptions(rooms=rooms)
    options: World = StreetOptions() if lidar else indoors
    recipe = "lidar" if lidar else "tum" if video else "demo"
    title = "scan the demo street" if lidar else f"render the demo's {'room' if rooms == 1 else f'{rooms} rooms'}"
    with ProgressBars.of(shown) as terminal, terminal.stage(title, options.frames) as advance:
        folder = demo_source(options=options, advance=advance)
    truth = named_truth(str(folder / TRUTH_FILE)) if lidar else []
    run(recipe, folder, out, [*truth, *overrides], shown, overwrite=overwrite, dask=dask)


def refine_trajectory(
    poses: Path,
    frames: Path,
    out: Path,
    match: str,
    recipe: str,
    overrides: Sequence[str],
    shown: Shown,
    *,
    force: bool,
    overwrite: bool,
    dask: str | None,
) -> None:
    """Run `slam_refine` on given poses and frames; `CheckError`, exit code 3, where the poses given are better."""
    from hodge_pipeline.uses.trajectory import recipe_for

    if not poses.exists():
        raise SourceError(f"{poses}: no such file or folder: give the poses to refine")
    ours = ["start.stage=given", f"start.path={json.dumps(str(poses))}", f"start.match={match}"]
    ours.append(f"guard.force={str(force).lower()}")
    run(recipe or recipe_for(frames), frames, out, [*ours, *overrides], shown, overwrite=overwrite, dask=dask)


def _print_summary(result: Run, *, verbose: bool) -> None:
    from hodge_pipeline.report.brief import all_notes, brief
    from hodge_pipeline.report.tables import graph_tables, score_tables

    if verbose:
        for table in (*score_tables(result.report), *graph_tables(result.report)):
            print_table(table.title, table.header, table.rows)
    lines = brief(result.report, str(result.folder))
    print("\n".join([*(all_notes(result.report) if verbose else []), *lines]))
