"""The `hodge` command. Only parsing happens here; each command imports what it needs when it runs."""

from __future__ import annotations

import os
import signal
from pathlib import Path
from typing import Annotated

import typer

from hodge_pipeline.cli import refine as refining
from hodge_pipeline.cli.error_lines import one_line_errors
from hodge_pipeline.cli.guard import guard_streams
from hodge_pipeline.cli.options import (
    Dask,
    Json,
    Out,
    Overrides,
    Overwrite,
    Quiet,
    Reader,
    ReaderSet,
    Shown,
    Strict,
    Trust,
    Truth,
    Verbose,
)  # fmt: skip

# OpenBLAS starts a thread for each core even for matrices of ten rows, of which a run has thousands: the threads wait
# for each other, and a diagnosis takes ten times the CPU time. What is large here is sparse and gains nothing by them.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

HELP = """Globally consistent poses from many scans.

Examples:

\b
  hodge demo --out runs/demo                     a room made in code, start to end
  hodge run seven_scenes --source redkitchen --out runs/kitchen
  hodge run tum --source rgbd_dataset_freiburg1_desk --out runs/desk
  hodge run tum --source DIR --set registration=ndt --out runs/ndt
  hodge inspect redkitchen                       what is this folder?
  hodge convert redkitchen poses.tum             poses, graphs, models in other formats
  hodge view runs/kitchen                        open the recording in Rerun
  hodge solve graph.g2o --out solved.g2o         any pose graph, or a run folder
  hodge solve graph.g2o --certificate --disable 12-87
  hodge diagnose runs/kitchen --out why          which edge is wrong?
  hodge review runs/kitchen                      see the edges, decide by hand
  hodge edit runs/kitchen --disable 12-87        take an edge out of a run,
  hodge solve runs/kitchen                       and solve and fuse it again
  hodge refine trajectory poses.txt --frames DIR --out runs/better
  hodge refine colmap sparse/0 --out runs/model
"""

HELP_OPTIONS = {"help_option_names": ["-h", "--help"]}

app = typer.Typer(
    help=HELP,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings=HELP_OPTIONS,
)

app.add_typer(refining.group, name="refine")


def _print_version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        print(f"hodge-pipeline {version('hodge-pipeline')}")
        raise typer.Exit


@app.callback()
def root(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Options of `hodge` itself."""


@app.command()
def run(
    recipe: Annotated[str, typer.Argument(help="A recipe by name (see `hodge recipes`) or a .yaml file.")],
    out: Out,
    source: Annotated[Path | None, typer.Option(help="What to read; overrides source.path.")] = None,
    truth: Truth = None,
    overrides: Overrides = None,
    overwrite: Overwrite = False,
    dask: Dask = None,
    live: Annotated[bool, typer.Option("--live", help="Show the run as it happens in a Rerun viewer.")] = False,
    stray: Annotated[list[str] | None, typer.Argument(hidden=True, metavar="--source PATH")] = None,
    strict: Strict = False,
    verbose: Verbose = False,
    quiet: Quiet = False,
    json: Json = False,
) -> None:
    """Run a recipe on a source: poses, fused model, report and recording in --out."""
    if stray:
        raise typer.BadParameter(f"'{stray[0]}': use --source to name what to read, one folder or file")
    from hodge_pipeline.cli import run as running

    sets = [*(overrides or []), *running.named_truth(truth)]
    shown = Shown(quiet, json, verbose)
    running.run(recipe, source, out, sets, shown, overwrite=overwrite, live=live, dask=dask, strict=strict)


@app.command()
def demo(
    out: Out,
    lidar: Annotated[
        bool, typer.Option("--lidar", help="A street scanned by a spinning LiDAR in place of the room.")
    ] = False,
    rooms: Annotated[
        int, typer.Option("--rooms", min=1, help="A walk through so many rooms and back, about 450 frames a room.")
    ] = 1,
    video: Annotated[
        bool,
        typer.Option("--video", help="The room as a video of 640x480 at 30 Hz, with rolling shutter and motion blur."),
    ] = False,
    overrides: Overrides = None,
    overwrite: Overwrite = False,
    dask: Dask = None,
    verbose: Verbose = False,
    quiet: Quiet = False,
) -> None:
    """Make a furnished room with Kinect-like noise and run the recipe `demo` on it (or a street: --lidar)."""
    from hodge_pipeline.cli import run as running

    if lidar + video + (rooms > 1) > 1:
        raise typer.BadParameter("--rooms, --video and --lidar are demos of their own: give one of them")
    shown = Shown(quiet, verbose=verbose)
    running.demo(out, overrides or [], shown, lidar=lidar, rooms=rooms, video=video, overwrite=overwrite, dask=dask)


@app.command()
def solve(
    graph: Annotated[Path, typer.Argument(help="A pose graph (g2o, TORO, …) or a run folder.")],
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", "-o", help="The result: .g2o or .json (Open3D) with edges; .tum, .kitti, .csv, .log without."
        ),
    ] = None,
    objective: Annotated[
        str | None, typer.Option(help="full: g2o's chi2, the default; isotropic: SE-Sync's F, which can be certified.")
    ] = None,
    start: Annotated[
        str, typer.Option(help="chordal: from the edges alone; given: from the file's poses.")
    ] = "chordal",
    robust: Annotated[
        bool,
        typer.Option(
            "--robust", help="Find wrong edges and leave them out; exit code 3 where nothing confirms the rest."
        ),
    ] = False,
    trust: Trust = None,
    certificate: Annotated[bool, typer.Option("--certificate", help="Prove the minimum global (isotropic).")] = False,
    sesync_units: Annotated[
        bool, typer.Option("--sesync-units", help="F as SE-Sync counts it: rotations weigh four times as much.")
    ] = False,
    disable: Annotated[
        list[str] | None,
        typer.Option(metavar="A-B", help="Leave out the edges between these vertex ids; may be repeated."),
    ] = None,
    time_limit: Annotated[float, typer.Option(help="Seconds after which the best so far is given.")] = float("inf"),
    run_folder: Annotated[Path | None, typer.Option("--run", help="Folder for report, edges and recording.")] = None,
    dask: Dask = None,
    verbose: Verbose = False,
    quiet: Quiet = False,
    json: Json = False,
) -> None:
    """Solve a pose graph: maximum-likelihood poses, certified where asked for."""
    from hodge_pipeline.cli import solve as solving

    options = solving.choices(
        objective, start, disable or [], time_limit, robust=robust, trust=trust, certificate=certificate,
        sesync_units=sesync_units,
    )  # fmt: skip
    solving.solve(graph, options, Shown(quiet, json, verbose), out=out, run_folder=run_folder, dask=dask)


@app.command()
def diagnose(
    path: Annotated[Path, typer.Argument(help="A finished run, or a pose graph (g2o, TORO, Open3D, pair .log).")],
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="Folder for edges.csv, poses.tum, diagnosis.html and diagnosis.rrd."),
    ] = None,
    top: Annotated[
        int | None, typer.Option(min=0, help="Edges to print; default: those that are not consistent, in ten lines.")
    ] = None,
    trust: Trust = None,
    verbose: Verbose = False,
    quiet: Quiet = False,
    json: Json = False,
) -> None:
    """Say which edges are wrong, why, and what to do: by the cycles that they lie in, before any solve."""
    from hodge_pipeline.cli import diagnose as diagnosing

    diagnosing.diagnose(path, out, Shown(quiet, json, verbose), top=top, trust=trust)


@app.command()
def edit(
    run_folder: Annotated[Path, typer.Argument(help="A finished run.")],
    disable: Annotated[
        list[str] | None,
        typer.Option(
            metavar="A-B",
            help="Switch the edges between two frames off; may be repeated, or A-B,C-D; `wrong`: all such.",
        ),
    ] = None,
    enable: Annotated[
        list[str] | None,
        typer.Option(metavar="A-B", help="Switch them on: disabled ones again, rejected ones in spite of the reason."),
    ] = None,
    right: Annotated[
        list[str] | None,
        typer.Option(metavar="A-B", help="Switch them on, and let no robust solver leave them out."),
    ] = None,
    register: Annotated[
        list[str] | None,
        typer.Option(metavar="A-B", help="Register a pair that is no edge, as `hodge diagnose` suggests some."),
    ] = None,
    undo: Annotated[bool, typer.Option("--undo", help="Take the last edit back.")] = False,
    listing: Annotated[bool, typer.Option("--list", help="Print every edit so far.")] = False,
    quiet: Quiet = False,
    json: Json = False,
) -> None:
    """Switch edges of a run off or on, or have more registered; `hodge solve RUN` then solves and fuses again."""
    from hodge_pipeline.cli import edit as editing

    pairs = editing.Pairs(disable or [], enable or [], register or [], right or [])
    editing.edit(run_folder, pairs, Shown(quiet, json), undo=undo, listing=listing)


@app.command()
def review(
    path: Annotated[
        Path, typer.Argument(help="A run, a COLMAP model, or a pose graph (g2o, TORO, Open3D, pair .log).")
    ],
    port: Annotated[int, typer.Option(min=0, max=65535, help="Of the page; 0: a free one.")] = 0,
    browser: Annotated[bool, typer.Option(help="Open the page in the browser.")] = True,
) -> None:
    """See edges and their clouds on a page that only this machine can open, decide by hand, and watch the map mend."""
    from hodge_pipeline.review.opening import open_review

    signal.signal(signal.SIGTERM, signal.default_int_handler)  # else its socket stays in the folder of temporary files
    with open_review(path, port=port, browser=browser) as opened:
        print(f"{opened.address}\nwhoever has this address can decide; Ctrl-C ends it", flush=True)
        opened.wait()


@app.command()
def inspect(source: Path, reader: Reader = None, overrides: ReaderSet = None, json: Json = False) -> None:
    """Say what a path is: format, frames, stamps, depth range, intrinsics, oddities."""
    from hodge_pipeline.cli import list as listing

    listing.inspect(source, reader=reader, settings=overrides or [], as_json=json)


@app.command()
def convert(
    source: Path,
    out: Annotated[Path, typer.Argument(help="Its name means the format: .tum .kitti .csv .g2o .json .ply, a folder.")],
    to: Annotated[str | None, typer.Option("--to", help="The writer by name (see `hodge stages writers`).")] = None,
    reader: Reader = None,
    overrides: ReaderSet = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace what is at OUT.")] = False,
) -> None:
    """Write what a path holds in another format."""
    from hodge_pipeline.cli import convert as converting

    converting.convert(source, out, to=to, reader=reader, settings=overrides or [], overwrite=overwrite)


@app.command()
def stages(
    kind: Annotated[str | None, typer.Argument(help="Only this kind, with every option.")] = None,
) -> None:
    """List the stages that are installed, and their options."""
    from hodge_pipeline.cli import list as listing

    listing.stages(kind)


@app.command()
def recipes(
    name: Annotated[str | None, typer.Argument(help="Print this one, with every default.")] = None,
    schema: Annotated[bool, typer.Option("--schema", help="Print NAME's JSON schema for editors.")] = False,
) -> None:
    """List the recipes that come with the package."""
    from hodge_pipeline.cli import list as listing

    listing.recipes(name, schema=schema)


@app.command("new-plugin")
def new_plugin(
    name: Annotated[str, typer.Argument(help="Of the stage, such as my_icp.")],
    kind: Annotated[str, typer.Option(help="registration: a registrar that wraps Open3D's ICP; readers: a format.")] = (
        "registration"
    ),
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Folder of the package; default: its name.")] = None,
) -> None:
    """Write a package with a stage of your own: its entry point, its test by the contract checks, a README."""
    from hodge_pipeline.cli import new_plugin as making

    making.new_plugin(name, kind, out or Path(f"hodge-{name.replace('_', '-')}"))


@app.command()
def view(
    run_folder: Path,
    web: Annotated[bool, typer.Option("--web", help="As a page that only this machine can see.")] = False,
) -> None:
    """Open a run's recording in the Rerun viewer."""
    from hodge_pipeline.cli import record as recording

    recording.view(run_folder, web=web)


@app.command()
def record(
    run_folder: Path,
    level: Annotated[str | None, typer.Option(help="summary, normal or full; default: as in the recipe.")] = None,
    max_megabytes: Annotated[float | None, typer.Option(help="Bound on the file; default: the recipe's.")] = None,
    quiet: Quiet = False,
) -> None:
    """Make the recording of a run again, at another size, without computing anything again."""
    from hodge_pipeline.cli import record as recording

    recording.record(run_folder, level, max_megabytes, quiet=quiet)


@app.command()
def compare(
    first: Annotated[Path, typer.Argument(help="A run folder.")],
    second: Annotated[Path, typer.Argument(help="Another run folder, of the same frames or not.")],
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Folder for compare.html and .rrd; default: the second.")
    ] = None,
) -> None:
    """Compare two runs: numbers, options that differ, poses and models."""
    from hodge_pipeline.cli import record as recording

    recording.compare(first, second, out)


def main() -> None:
    """Run the command; see `one_line_errors`."""
    guard_streams()
    with one_line_errors():
        app(standalone_mode=True)  # which ends with 130 on Ctrl-C


if __name__ == "__main__":
    main()
