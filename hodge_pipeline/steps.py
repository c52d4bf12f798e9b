"""The steps of a run: each computes its artifacts once, under the key of what it depends on, and reads them back."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from hodge_pipeline import artifacts
from hodge_pipeline.fusion.ply import write_ply
from hodge_pipeline.job import Job
from hodge_pipeline.types import Candidates, CloudSet, Floats, Solution, Source, ViewGraph


@dataclass(frozen=True)
class Round:
    """One outer iteration: its edges, and the poses that they led to. The first is the odometry: no candidates."""

    graph: ViewGraph
    world_from_cam: Floats
    candidates: Candidates | None = None
    solution: Solution | None = None


def solve(job: Job, number: int, graph: ViewGraph, world_from_cam: Floats) -> Solution:
    """The consistent poses of round `number`."""
    name = f"solve-{number}"
    with job.stage(name, f"solve {number}", 1, job.recipe.solver, (f"register-{number}",)) as (folder, advance):
        if not folder.finished:
            solution = job.recipe.solver.solve(graph, world_from_cam)
            for note in solution.notes:
                job.note(note)
            artifacts.save_solution(folder.path / "solution.npz", solution)
            advance(1)
    return artifacts.load_solution(job.path(name) / "solution.npz")


def propose_edges(job: Job, number: int, source: Source, clouds: CloudSet, world_from_cam: Floats) -> Candidates:
    """The pairs to register in round `number`, from the poses so far."""
    name = f"edges-{number}"
    before = "odometry" if number == 1 else f"solve-{number - 1}"
    with job.stage(name, f"edges {number}", 1, job.recipe.edges, ("clouds", before)) as (folder, advance):
        if not folder.finished:
            candidates = job.recipe.edges.propose(source.frames, clouds, world_from_cam)
            artifacts.save(folder.path / "candidates.npz", candidates)
            advance(1)
    return artifacts.load(job.path(name) / "candidates.npz", Candidates)


def fuse(job: Job, source: Source, world_from_cam: Floats) -> dict[str, Path]:
    """The PLY file of each model."""
    last = f"solve-{job.recipe.outer_iterations}"
    files = {}
    for fuser in job.recipe.fusion:
        name = f"fuse-{type(fuser).__name__}"
        with job.stage(name, "fusion", len(source.frames), fuser, ("source", last)) as (folder, advance):
            if not folder.finished:
                model = fuser.fuse(source.frames, world_from_cam, advance)
                for note in model.notes:
                    job.note(note)
                write_ply(folder.path / "model.ply", model)
        files[name] = job.path(name) / "model.ply"
    return files
