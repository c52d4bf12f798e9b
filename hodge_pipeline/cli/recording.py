"""The commands about recordings: `hodge record`."""

from __future__ import annotations

from pathlib import Path
from typing import Any, get_args

from hodge_pipeline import registry
from hodge_pipeline.cli.console import Terminal
from hodge_pipeline.errors import RecipeError
from hodge_pipeline.recording.options import Level


def record(run_folder: Path, level: str | None, max_megabytes: float | None, *, quiet: bool) -> None:
    """Make a run's recording again and say where it is."""
    levels = [name for name in get_args(Level) if name != "off"]
    if level is not None and level not in levels:
        raise RecipeError(f"--level {level}: expected {', '.join(levels)}{registry.suggestion(level, levels)}")
    if max_megabytes is not None and not max_megabytes > 0:
        raise RecipeError(f"--max-megabytes {max_megabytes:g}: expected a size above zero")
    from hodge_pipeline.replay import record_again

    given: dict[str, Any] = {"level": level, "max_megabytes": max_megabytes}
    with Terminal(quiet) as terminal:
        path, missing = record_again(
            run_folder, {name: value for name, value in given.items() if value is not None}, terminal
        )
    if not quiet:
        print(f"{path}: {path.stat().st_size / 1e6:.1f} MB")
        if missing:
            print(f"the run is not finished: it is recorded up to the stage '{missing}'")
