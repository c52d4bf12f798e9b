"""A run walked again without computing: what its folder holds is recorded, or read."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from hodge_pipeline import registry
from hodge_pipeline.errors import WorkspaceError
from hodge_pipeline.pipeline import compute, read
from hodge_pipeline.recipe import binding
from hodge_pipeline.recipe.schema import Recipe, load_recipe
from hodge_pipeline.recording.run import FILE, Recording
from hodge_pipeline.store import artifacts
from hodge_pipeline.store.job import Job, Unfinished, log, logging_to
from hodge_pipeline.store.progress import Nobody, Watcher
from hodge_pipeline.store.workspace import RECIPE_FILE, Workspace


def recipe_of(folder: Path) -> Recipe:
    """The recipe of a run folder. Raises `WorkspaceError` where it is none."""
    if not (folder / RECIPE_FILE).is_file():
        raise WorkspaceError(f"{folder}: is no run folder: there is no {RECIPE_FILE} in it")
    return load_recipe(str(folder / RECIPE_FILE))


def _solved_without_scores(folder: Path) -> bool:
    """Whether the run ended without scores, as it does when it is solved again after an edit."""
    report = folder / "report.json"
    return report.is_file() and artifacts.read_json(report)["scores"] is None


def record_again(folder: Path, options: Mapping[str, Any], watcher: Watcher | None = None) -> tuple[Path, str]:
    """The recording of a run made again with other options (see `RecordingOptions`); where it lies, and the title of
    the first stage that the run has not finished, empty where it is complete.

    Nothing is computed again, so a run that was killed is recorded as far as it came.
    """
    recipe = recipe_of(folder)
    changed = dataclasses.replace(
        recipe,
        recording=dataclasses.replace(recipe.recording, **options),
        executor=registry.load("executors", "local")(workers=0),
    )
    if changed.recording.level == "off":
        raise WorkspaceError(f"{folder}: its recipe records nothing: add --level normal")
    with Workspace.reopen(folder, binding.unbind(recipe)) as workspace, logging_to(folder / "log.txt"):
        job = Job(changed, workspace, watcher or Nobody(), computes=False, scoring=not _solved_without_scores(folder))
        log.info("recording made again from the run folder")
        missing = ""
        try:
            source = read(job)
            with Recording(job, source) as recording:
                compute(job, source, recording)
        except Unfinished as unfinished:
            missing = str(unfinished)
            if unfinished.stale:
                raise WorkspaceError(
                    f"{folder}: the stage '{missing}' was {unfinished.stale}: run the recipe again, "
                    "or record it where it was made"
                ) from unfinished
    return folder / FILE, missing
