"""The commands that make existing poses better: `hodge refine`. Only parsing happens here."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from hodge_pipeline.cli.options import Dask, Force, Json, Overrides, Overwrite, Quiet, Shown, Truth, Verbose

HELP = """Make the poses of COLMAP or SLAM better, in their own format.

The result is measured before it is written: where it is worse by its own measures the input is given back byte for
byte and the exit code is 3 (--force writes the result all the same).

A graph file (g2o, TORO, …) needs no frames: give it to `hodge solve`.

Examples:

\b
  hodge refine trajectory CameraTrajectory.txt --frames DIR --out runs/desk
  hodge refine trajectory scene/trajectory.log --frames DIR --out runs/scene
  hodge refine colmap sparse/0 --database database.db --out runs/model
  hodge refine colmap sparse --depth DIR --depth-scale 1000 --out runs/metric
"""

group = typer.Typer(help=HELP, no_args_is_help=True, rich_markup_mode=None)


@group.command()
def trajectory(
    poses: Annotated[
        Path, typer.Argument(help="TUM, KITTI, EuRoC csv, Redwood .log, MCAP, 7-Scenes poses, Open3D JSON.")
    ],
    frames: Annotated[Path, typer.Option("--frames", help="The sequence the poses belong to, with depth or clouds.")],
    out: Annotated[
        Path, typer.Option("--out", "-o", help="The run folder: refined.<suffix of POSES>, report, recording.")
    ],
    match: Annotated[
        str, typer.Option(help="How a pose finds its frame: stamp, number, row (n-th pose, n-th frame), or auto.")
    ] = "auto",
    truth: Truth = None,
    force: Force = False,
    recipe: Annotated[
        str, typer.Option("--recipe", help="A recipe like slam_refine; none: by the frames, also _tum or _scans.")
    ] = "",
    overrides: Overrides = None,
    dask: Dask = None,
    overwrite: Overwrite = False,
    verbose: Verbose = False,
    quiet: Quiet = False,
    json: Json = False,
) -> None:
    """Refine SLAM poses with the frames they belong to: loops, registration, a robust solve."""
    from hodge_pipeline.cli import run as running

    sets, how = [*running.named_truth(truth), *(overrides or [])], {"force": force, "overwrite": overwrite}
    shown = Shown(quiet, json, verbose)
    running.refine_trajectory(poses, frames, out, match, recipe, sets, shown, dask=dask, **how)


@group.command()
def colmap(
    model: Annotated[Path, typer.Argument(help="A COLMAP model, .bin or .txt; or the folder of several: 0, 1, …")],
    out: Annotated[
        Path,
        typer.Option("--out", "-o", help="The run folder: sparse/0 (the model), report; it goes on where it stopped."),
    ],
    database: Annotated[
        Path | None,
        typer.Option("--database", help="COLMAP's database.db; default: the one beside or above the model."),
    ] = None,
    images: Annotated[
        Path | None,
        typer.Option("--images", help="Folder of the colour images; default: images/ beside or above the model."),
    ] = None,
    depth: Annotated[
        Path | None,
        typer.Option("--depth", help="Folder of sensor depth, PNGs named as the images (or depth for color)."),
    ] = None,
    depth_scale: Annotated[
        float | None,
        typer.Option("--depth-scale", help="Stored units of depth to the metre; default: the recipe's, 1000."),
    ] = None,
    depth_camera: Annotated[
        tuple[float, float, float, float] | None,
        typer.Option("--depth-camera", help="FX FY CX CY of depth that is not on the pixels of the colour images."),
    ] = None,
    positions: Annotated[
        str | None,
        typer.Option("--positions", help="Known positions: database (GPS, gravity), or a table; metric result there."),
    ] = None,
    refine: Annotated[
        str | None,
        typer.Option("--refine", help="Refine focal (lengths), all (intrinsics), rig, or none (default): all held."),
    ] = None,
    force: Force = False,
    recipe: Annotated[str, typer.Option("--recipe", help="A recipe like colmap_refine, by name or file.")] = "",
    overrides: Overrides = None,
    dask: Dask = None,
    overwrite: Annotated[bool, typer.Option(help="Replace another refined model in --out.")] = False,
    verbose: Verbose = False,
    quiet: Quiet = False,
    json: Json = False,
) -> None:
    """Refine a COLMAP model: edges measured anew, a robust solve, bundle adjustment; metric where there is depth."""
    from hodge_pipeline.cli import refine_colmap as refining_colmap

    beside = {"database": database, "images": images, "depth": depth, "depth_scale": depth_scale}
    given = {**beside, "positions": positions, "refine": refine}
    sets = [f"model.{name}={value}" for name, value in given.items() if value is not None]
    if depth_camera is not None:
        sets.append(f"model.depth_camera=[{', '.join(map(str, depth_camera))}]")
    sets, how = [*sets, *(overrides or [])], {"force": force, "overwrite": overwrite}
    refining_colmap.refine(model, out, sets, Shown(quiet, json, verbose), recipe=recipe, dask=dask, **how)
