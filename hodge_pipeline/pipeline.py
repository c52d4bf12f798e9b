"""The method on one screen: read, register in sequence, then edges, registration and solve until consistent; fuse."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from hodge_pipeline import binding, outputs, steps
from hodge_pipeline.evaluation.report import Report
from hodge_pipeline.job import Job
from hodge_pipeline.recipe import Recipe, load_recipe
from hodge_pipeline.types import Floats, Solution, Source, ViewGraph
from hodge_pipeline.watch import Nobody, Watcher
from hodge_pipeline.workspace import Workspace


@dataclass(frozen=True)
class Run:
    """A finished run: its folder, and what a script wants of it. `world_from_cam (N, 4, 4)` in frame order."""

    folder: Path
    source: Source
    world_from_cam: Floats
    graph: ViewGraph
    solution: Solution
    report: Report


def run(
    recipe: Recipe | str,
    out: Path | str,
    *,
    source: Path | str | None = None,
    overwrite: bool = False,
    watcher: Watcher | None = None,
) -> Run:
    """Run a recipe (its name, its file or itself) into the folder `out`, going on where an earlier run stopped.

    Raises `HodgeError` (see `errors`) for whatever the user can mend.
    """
    if isinstance(recipe, str):
        recipe = load_recipe(recipe, source=None if source is None else Path(source))
    folder = Path(out)
    with Workspace.open(folder, binding.unbind(recipe), overwrite=overwrite) as workspace, _log_file(folder):
        return _run(Job(recipe, workspace, watcher or Nobody()))


def _run(job: Job) -> Run:
    recipe = job.recipe
    source = read(job)
    clouds = steps.prepare_clouds(job, source)
    graph, poses = steps.odometry(job, source, clouds)
    rounds = [steps.Round(graph, poses)]
    for number in range(1, recipe.outer_iterations + 1):
        candidates = steps.propose_edges(job, number, source, clouds, poses)
        graph = steps.register_edges(job, number, source, candidates, poses)
        solution = steps.solve(job, number, graph, poses)
        poses = solution.world_from_cam
        rounds.append(steps.Round(graph, poses, candidates, solution))
    models = steps.fuse(job, source, poses)
    scores = steps.evaluate(job, source, rounds)
    report = outputs.write(job, source, rounds, models, scores)
    return Run(job.workspace.folder, source, poses, graph, solution, report)
