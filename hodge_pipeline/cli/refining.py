"""The commands that make existing poses better: `hodge refine`. Only parsing happens here."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Optional

import typer

HELP = """Make the poses of COLMAP or SLAM better, in their own format.

The result is measured before it is written: where it is worse by its own measures the input is given back byte for
byte and the exit code is 3 (--force writes the result all the same).

A graph file (g2o, TORO, …) needs no frames: give it to `hodge solve`.

Examples:

\b
  hodge refine trajectory CameraTrajectory.txt --frames rgbd_dataset_freiburg1_desk --out runs/desk
  hodge refine trajectory scene/trajectory.log --frames DIR --out runs/scene
"""

group = typer.Typer(help=HELP, no_args_is_help=True, rich_markup_mode=None)


@group.command()
def trajectory(
    poses: Annotated[
        Path, typer.Argument(help="TUM, KITTI, EuRoC csv, Redwood .log, MCAP, 7-Scenes poses, Open3D JSON.")
    ],
    frames: Annotated[Path, typer.Option("--frames", help="The sequence the poses belong to, with depth or clouds.")],
    out: Annotated[Path, typer.Option("--out", help="The run folder: refined.<suffix of POSES>, report, recording.")],
    match: Annotated[
        str, typer.Option(help="How a pose finds its frame: stamp, number, row (n-th pose, n-th frame), or auto.")
    ] = "auto",
    force: Annotated[bool, typer.Option("--force", help="Write the result even where it is worse.")] = False,
    overrides: Annotated[
        Optional[list[str]],  # noqa: UP045 - typer reads Optional on Python 3.10 as well
        typer.Option("--set", metavar="KEY=VALUE", help="Change an option of the recipe slam-refine."),
    ] = None,
    overwrite: Annotated[bool, typer.Option(help="Replace the run of another recipe in --out.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", help="Print nothing but errors.")] = False,
    json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
) -> None:
    """Refine SLAM poses with the frames they belong to: loops, registration, a robust solve."""
    from hodge_pipeline.cli import refining_trajectory

    refining_trajectory.refine(
        poses, frames, out, match, overrides or [], force=force, overwrite=overwrite, quiet=quiet, as_json=json
    )
