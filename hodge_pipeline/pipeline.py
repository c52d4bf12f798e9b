"""The method on one screen: read, register in sequence, then edges, registration and solve until consistent; fuse."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import chain
from pathlib import Path

from hodge_pipeline import steps
from hodge_pipeline.evaluation.scores import ScoreTable
from hodge_pipeline.pairs.by_hand import edited_rounds
from hodge_pipeline.pairs.edits import listed_edges
from hodge_pipeline.pairs.suggested import suggested_rounds
from hodge_pipeline.recipe import binding
from hodge_pipeline.recipe.scale import apply_scale
from hodge_pipeline.recipe.schema import Recipe, load_recipe, with_source
from hodge_pipeline.recording.run import Recording
from hodge_pipeline.refine import verdict
from hodge_pipeline.refine.verdict import Refined
from hodge_pipeline.report import run_files
from hodge_pipeline.report.contents import Report
from hodge_pipeline.scene import Round
from hodge_pipeline.start import first_poses, key_frames
from hodge_pipeline.start.key_frames import Tracked
from hodge_pipeline.store.job import Job, logging_to
from hodge_pipeline.store.progress import Nobody, Watcher
from hodge_pipeline.store.workspace import RECIPE_FILE, Workspace
from hodge_pipeline.types import Source


@dataclass(frozen=True)
class Run:
    """A finished run: its folder, what was read, its last round (graph, solution, poses in frame order), the report.

    Where it started from given poses the source holds the key frames, and `refined` the decision and all poses. Of a
    long source it holds the key frames too, and `tracked.all_poses(result.world_from_cam)` are the poses of all frames.
    """

    folder: Path
    source: Source
    result: Round
    report: Report
    refined: Refined | None = None
    tracked: Tracked | None = None


def run(
    recipe: Recipe | str,
    out: Path | str,
    *,
    source: Path | str | Source | None = None,
    overwrite: bool = False,
    watcher: Watcher | None = None,
    live: str | None = None,
    dask: str | None = None,
) -> Run:
    """Run a recipe (its name, its file or itself) into the folder `out`, going on where an earlier run stopped.

    A `source` may be opened already; a run of frames that are in memory cannot be resumed by another process.
    `live` is the address of a Rerun viewer that shows the run as it happens; `dask` that of a Dask scheduler whose
    workers see the same files, and which is trusted to run code here.
    Raises `HodgeError` (see `errors`) for whatever the user can mend.
    """
    if isinstance(recipe, str):
        recipe = load_recipe(recipe)
    opened = source if isinstance(source, Source) else None
    if source is not None:
        recipe = with_source(recipe, Path(source.path if isinstance(source, Source) else source))
    folder = Path(out)
    with (
        Workspace.open(folder, binding.unbind(recipe), overwrite=overwrite) as workspace,
        logging_to(folder / "log.txt"),
    ):
        return _run(Job(recipe, workspace, watcher or Nobody(), live=live, dask=dask, opened=opened))


def solve_again(folder: Path | str, *, watcher: Watcher | None = None, dask: str | None = None) -> Run:
    """Solve and fuse a finished run once more, with the edits in its folder, and bring all that it left up to date.

    Nothing is registered and no score is measured again: `run` with the same recipe does that. `dask` is as of `run`.
    Raises `HodgeError`.
    """
    folder = Path(folder)
    listed_edges(folder)
    recipe = load_recipe(str(folder / RECIPE_FILE))
    with Workspace.reopen(folder, binding.unbind(recipe)) as workspace, logging_to(folder / "log.txt"):
        return _run(Job(recipe, workspace, watcher or Nobody(), dask=dask, scoring=False))


def _run(job: Job) -> Run:
    source = read(job)
    with Recording(job, source) as recording:
        rounds, models, scores = compute(job, source, recording)
    refined = None if job.given is None else verdict.finish(job, job.given, rounds)
    report = run_files.write(job, source, rounds, models, scores, refined)
    return Run(job.workspace.folder, source, rounds[-1], report, refined, job.tracked)


def read(job: Job) -> Source:
    """The source, of a long one its key frames; the recipe's lengths are those of its scene from here on."""
    source = steps.read(job)
    apply_scale(job, source)
    return key_frames.key_frames(job, source)


def compute(job: Job, source: Source, recording: Recording) -> tuple[list[Round], dict[str, Path], ScoreTable | None]:
    """The rounds, the models' files by name, the scores: every stage in order, each recorded once it is done."""
    measured = steps.measured(job, source)
    with job.workers() as workers:
        clouds = steps.prepare_clouds(job, source, workers)
        recording.clouds(clouds)
        rounds = [first_poses.first_poses(job, source, workers)]
        recording.first_poses(rounds[0])
        for number in range(1, job.recipe.outer_iterations + 1):
            poses = rounds[-1].world_from_cam
            proposed = steps.propose_edges(job, number, source, clouds, poses, measured)
            candidates = first_poses.with_start_edges(proposed, rounds[0])
            registered = steps.register_edges(job, number, candidates, poses, workers)
            recording.registration(number, registered, poses, clouds)
            rounds.append(steps.solve(job, number, source, registered, poses, measured))
            recording.round(number, rounds[-1])
        suggested = suggested_rounds(job, source, clouds, measured, rounds, workers)
        for more in chain(suggested, edited_rounds(job, source, measured, rounds, workers)):
            if len(more.registered):
                recording.registration(len(rounds), more.registered, more.before, clouds)
            rounds.append(more.round)
            recording.round(len(rounds) - 1, more.round)
        rounds[-1] = steps.judge_edges(job, rounds[-1], len(rounds) - 1)
        recording.diagnosis(rounds[-1])
        scores = steps.evaluate(job, source, rounds, workers)
        recording.scores(scores)
    frames, poses = key_frames.frames_to_fuse(job, source, rounds[-1])
    models = steps.fuse(job, frames, poses, len(rounds) - 1)
    recording.models(models)
    return rounds, models, scores
