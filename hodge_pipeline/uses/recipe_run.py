"""Run a recipe into a folder, or solve a finished run again with its edits."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from hodge_pipeline.errors import RecipeError, SourceError
from hodge_pipeline.pairs.edits import listed_edges
from hodge_pipeline.pipeline import Computed, Job, compute
from hodge_pipeline.recipe import binding
from hodge_pipeline.recipe.recipe_file import recipe_names
from hodge_pipeline.recipe.scale import with_scale
from hodge_pipeline.recipe.schema import Recipe, load_recipe, with_source
from hodge_pipeline.recording.run import Recording
from hodge_pipeline.registry import plugin_errors
from hodge_pipeline.report import run_files
from hodge_pipeline.run_folder import Run, check_layout, end
from hodge_pipeline.sources.colour_on_depth import image_doubts, usable_colour
from hodge_pipeline.sources.opening import (
    Fingerprints,
    changed_since,
    check_measurable,
    fingerprints,
    lacking,
    open_with_reader,
    remembered,
)
from hodge_pipeline.start.truth import with_truth
from hodge_pipeline.store.log import logging_to
from hodge_pipeline.store.progress import Watcher
from hodge_pipeline.store.store import Store
from hodge_pipeline.store.workspace import LOG_FILE, RECIPE_FILE, Workspace, disk_errors
from hodge_pipeline.types import Source
from hodge_pipeline.types.notes import Note, notes_of


@plugin_errors()
def run(
    recipe: Recipe | str,
    out: Path | str,
    *,
    source: Path | str | Source | None = None,
    overwrite: bool = False,
    watcher: Watcher | None = None,
    live: str | None = None,
    dask: str | None = None,
    strict: bool = False,
) -> Run:
    """Run a recipe (its name, its file or itself) into the folder `out`, going on where an earlier run stopped.

    - `source`: a path, or a source that is open; frames in memory cannot be resumed by another process.
    - `overwrite`: replace the run of another recipe in `out`.
    - `live`: the address of a Rerun viewer that shows the run as it happens.
    - `dask`: the address of a Dask scheduler whose workers see the same files; it is trusted to run code here.
    - `strict`: notice input that changes during the run by hashes of every file, not by sizes and times alone.

    Raises `HodgeError` (see `errors`) for whatever the user can mend.
    """
    if isinstance(recipe, str):
        recipe = load_recipe(recipe)
    opened = source if isinstance(source, Source) else None
    if source is not None:
        recipe = with_source(recipe, Path(source.path if isinstance(source, Source) else source))
    folder = _for_workers(Path(out), dask)
    with (
        Workspace.open(folder, binding.unbind(recipe), overwrite=overwrite) as workspace,
        disk_errors(folder),
        logging_to(folder / LOG_FILE),
    ):
        store = Store(workspace.steps, watcher)
        return _Run(recipe, workspace.folder, store, live, dask, opened, strict=strict).finished()


def _for_workers(path: Path, dask: str | None) -> Path:
    """The path, absolute where workers of a cluster read it: they run in other folders."""
    return path.absolute() if dask else path


@plugin_errors()
def solve_again(folder: Path | str, *, watcher: Watcher | None = None, dask: str | None = None) -> Run:
    """Solve and fuse a finished run again with the edits in its folder, and bring everything in it up to date.

    Only pairs that edits add are registered; scores are not measured again, which `run` with the same recipe does.
    `dask` is as of `run`. Raises `HodgeError`.
    """
    folder = _for_workers(Path(folder), dask)
    listed_edges(folder)
    check_layout(folder)
    recipe = load_recipe(str(folder / RECIPE_FILE))
    with (
        Workspace.reopen(folder, binding.unbind(recipe)) as workspace,
        disk_errors(folder),
        logging_to(folder / LOG_FILE),
    ):
        return _Run(recipe, workspace.folder, Store(workspace.steps, watcher), dask=dask, again=True).finished()


@dataclass(frozen=True)
class _Run:
    """One run in progress."""

    recipe: Recipe
    folder: Path
    store: Store
    live: str | None = None
    dask: str | None = None
    opened: Source | None = None
    again: bool = False
    strict: bool = False

    def finished(self) -> Run:
        """The finished run."""
        source, before = self._read()
        recipe = with_scale(self.recipe, source, self.store)
        job = Job(recipe, source, self.store, self.folder, self.dask, self.again)
        with Recording(self.store, self.folder, recipe, source, self.live) as recording:
            found = compute(job, recording)
        self.store.note(*changed_since(before, strict=self.strict))
        return self._written(job, found)

    def _read(self) -> tuple[Source, Fingerprints]:
        """The source, opened, and the fingerprints of its files; images stay on disk."""
        path = self.recipe.source.path
        if path is None:
            raise RecipeError("source.path: the recipe names no source: give one (--source PATH)")
        path = _for_workers(path, self.dask)
        source, reader = (
            (self.opened, None) if self.opened else open_with_reader(path, self.recipe.source.reader, recipe_names())
        )
        if not source.frames:
            raise SourceError(f"{path}: has no frames to register: give a sequence with depth or clouds")
        check_measurable(source)
        self.store.note(*notes_of("reader", source.notes), *source.doubts)
        doubts = image_doubts(source.frames)
        self.store.note(*doubts, *lacking(source))
        source = usable_colour(source, doubts)
        if len(source.frames) == 1:
            self.store.note(Note("single frame", detail=str(path)))
        prints = fingerprints(source.files, strict=self.strict)
        source = remembered(source, reader, self.store, prints)
        return with_truth(source, self.recipe.evaluation.truth, self.store), prints

    def _written(self, job: Job, found: Computed) -> Run:
        """Write report, poses and models into the folder; the finished run."""
        scene, rounds = found.scene, found.rounds
        report = run_files.write(
            self.folder, job.recipe, self.store, scene, rounds, found.poses, found.models, found.scores, found.refined
        )
        ending = self.store.step(end, found.poses, report, found.refined, title="report")
        return Run(
            self.folder, scene.whole, scene.key_frames, scene.clouds, rounds, found.poses, found.models, found.scores,
            ending,
        )  # fmt: skip
