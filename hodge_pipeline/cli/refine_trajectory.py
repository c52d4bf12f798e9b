"""`hodge refine trajectory`: the recipe `slam_refine` on given poses and frames."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

from hodge_pipeline.cli import run as running
from hodge_pipeline.errors import SourceError
from hodge_pipeline.start.match_poses import recipe_for


def refine(
    poses: Path,
    frames: Path,
    out: Path,
    match: str,
    recipe: str,
    overrides: Sequence[str],
    *,
    force: bool,
    overwrite: bool,
    quiet: bool,
    as_json: bool,
    dask: str | None,
    verbose: bool = False,
) -> None:
    """Run the recipe and print what came out; `CheckError`, exit code 3, where the poses given are kept as better."""
    if not poses.exists():
        raise SourceError(f"{poses}: no such file or folder: give the poses to refine")
    start = ["start.stage=given", f"start.path={json.dumps(str(poses))}", f"start.match={match}"]
    ours = [*start, f"guard.force={str(force).lower()}"]
    chosen = recipe or recipe_for(frames)
    running.run(
        chosen,
        frames,
        out,
        [*ours, *overrides],
        overwrite=overwrite,
        quiet=quiet,
        as_json=as_json,
        dask=dask,
        verbose=verbose,
    )
