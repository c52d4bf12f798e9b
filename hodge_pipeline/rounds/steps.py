"""The steps of a run: each computes its artifacts once, under the key of what it depends on, and reads them back."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hodge_pipeline import se3
from hodge_pipeline.diagnosis.diagnosis import diagnose
from hodge_pipeline.errors import RecipeError, SourceError
from hodge_pipeline.evaluation.residuals import with_residuals
from hodge_pipeline.evaluation.scaled_scores import scaled_score_table
from hodge_pipeline.evaluation.scores import GRAPH_KINDS, GraphScores, ScoreTable
from hodge_pipeline.fusion.ply import write_ply
from hodge_pipeline.recipe.schema import cloud_options
from hodge_pipeline.refine.held_out import is_held_out
from hodge_pipeline.registration import clouds as cloud_stage
from hodge_pipeline.registration import odometry as odometry_stage
from hodge_pipeline.registration import pairs as pair_stage
from hodge_pipeline.registration.acceptance import accepted
from hodge_pipeline.registration.block_store import BlockStore
from hodge_pipeline.registration.gaps import has_gap
from hodge_pipeline.scene import Round, has_truth, pose_sets, sequences_of, true_poses
from hodge_pipeline.sources.measured_edges import digest, measured_edges, without_measured
from hodge_pipeline.sources.opening import open_source
from hodge_pipeline.stages import Workers
from hodge_pipeline.start import given
from hodge_pipeline.start.unordered.tour import propose_along_tour
from hodge_pipeline.store import artifacts
from hodge_pipeline.store.job import Job, unnamed_key
from hodge_pipeline.types import CloudSet, Edges, Floats, Frame, Solution, Source, ViewGraph
from hodge_pipeline.types.edges import HELD_OUT

EDGES = "edges.npz"


def read(job: Job) -> Source:
    """The source, opened; its images stay on disk. Where the run starts from given poses, its key frames alone."""
    path = job.recipe.source.path
    if path is None:
        raise RecipeError("source.path: the recipe names no source: give one (--source PATH)")
    source, key = (job.opened, unnamed_key()) if job.opened else open_source(path, job.recipe.source.reader)
    if not source.frames:
        raise SourceError(f"{path}: has no frames to register: give a sequence with depth or clouds")
    for note in source.notes:
        job.note(note)
    if len(source.frames) == 1:
        job.note(f"{path}: has a single frame: there is nothing to register, the model is that frame alone")
    job.keys["source"] = key
    if job.recipe.given.poses == "none":
        return source
    job.given = given.given_poses(job, source)
    return given.key_source(job.given, job.recipe.given.poses == "frames")


def measured(job: Job, source: Source) -> ViewGraph:
    """The edges that come measured, over the frames: they join every round's graph as they are."""
    graph, notes = measured_edges(source, job.recipe.measured)
    for note in notes:
        job.note(note)
    job.keys["measured"] = digest(graph)
    return graph


def prepare_clouds(job: Job, source: Source, workers: Workers) -> CloudSet:
    """The down-sampled cloud of each frame; where the source was tracked they are there."""
    if job.tracked is not None:
        return CloudSet.open(job.path("clouds"))
    sequences = list(sequences_of(source).values())
    apart = len(sequences) > 1 or has_gap(sequences, np.array([frame.stamp_s for frame in source.frames]))
    options, total = cloud_options(job.recipe, apart), len(source.frames)
    with job.stage("clouds", "clouds", total, options, ("source",)) as (folder, advance):
        if not folder.finished:
            clouds, notes = cloud_stage.prepare_clouds(source.frames, options, workers, advance)
            clouds.save(folder.path)
            for note in notes:
                job.note(note)
    return CloudSet.open(job.path("clouds"))


def propose_edges(
    job: Job, number: int, source: Source, clouds: CloudSet, world_from_cam: Floats, measured: ViewGraph
) -> Edges:
    """The pairs to register in round `number`, from the poses so far; measured ones are not registered again.

    Where the run starts from given poses a share of them is kept out, for its guard.
    """
    name = f"edges-{number}"
    before = _first_stage(job) if number == 1 else f"solve-{number - 1}"
    inputs = ("clouds", "measured", before)
    options = (job.recipe.edges, None if job.given is None else job.recipe.guard.held_out)
    with job.stage(name, f"edges, round {number}", 1, options, inputs) as (folder, advance):
        if not folder.finished:
            propose = job.recipe.edges.propose
            if job.recipe.start == "global":
                propose = partial(propose_along_tour, job.recipe.edges)
            candidates = without_measured(propose(source.frames, clouds, world_from_cam), measured)
            if job.given is not None:
                out = is_held_out(candidates, job.recipe.guard.held_out, job.recipe.seed)
                candidates = candidates.put(out, status=HELD_OUT)
            artifacts.save(folder.path / EDGES, candidates)
            advance(1)
    return artifacts.load(job.path(name) / EDGES, Edges)


def _first_stage(job: Job) -> str:
    """The stage that the first poses come from."""
    return "start" if "start" in job.keys else "odometry"


def odometry(job: Job, source: Source, workers: Workers) -> Round:
    """The first poses, from consecutive frames alone."""
    options = job.recipe.odometry
    stamps = np.array([frame.stamp_s for frame in source.frames])
    sequences = list(sequences_of(source).values())
    with job.stage("odometry", "odometry", len(stamps), options, ("clouds",)) as (folder, advance):
        if not folder.finished:
            found = odometry_stage.odometry(job.path("clouds"), sequences, stamps, options, workers, advance)
            artifacts.save(folder.path / "steps.npz", found.steps)
            artifacts.save_arrays(folder.path / "poses.npz", {"world_from_cam": found.world_from_cam})
            for note in found.notes:
                job.note(note)
    steps = artifacts.load(job.path("odometry") / "steps.npz", Edges)
    poses = artifacts.load_arrays(job.path("odometry") / "poses.npz")["world_from_cam"]
    return Round(steps, vertex_ids(source), poses)


def register_edges(job: Job, number: int, edges: Edges, world_from_cam: Floats, workers: Workers) -> Edges:
    """The table of round `number` with its candidates registered from the poses so far, and accepted or rejected.

    A killed run goes on at its last block.
    """
    held_out = edges.status == HELD_OUT
    candidates = edges.select(~held_out)
    i, j = candidates.pairs.T
    guesses = se3.inverse(world_from_cam[i]) @ world_from_cam[j]
    name, title, inputs = f"register-{number}", f"registration, round {number}", ("clouds", f"edges-{number}")
    with job.stage(name, title, len(candidates), job.recipe.registration, inputs) as (folder, advance):
        if not folder.finished:
            blocks = BlockStore(folder.path / "blocks")
            found = pair_stage.register_pairs(
                job.path("clouds"), job.recipe.registration, candidates, guesses, workers, advance,
                finished=blocks.read(), on_block=blocks.write,
            )  # fmt: skip
            artifacts.save(folder.path / EDGES, Edges.joined([found, edges.select(held_out)]))
            blocks.remove()
    return accepted(job, artifacts.load(job.path(name) / EDGES, Edges))


def solve(job: Job, number: int, source: Source, registered: Edges, start: Floats, measured: ViewGraph) -> Round:
    """Round `number`: the accepted and the measured edges, and the poses consistent with them from `start`."""
    name, options = f"solve-{number}", (job.recipe.acceptance, job.recipe.solver)
    edges, ids = Edges.joined([registered, Edges.measured(measured)]), vertex_ids(source)
    with job.stage(name, f"solve, round {number}", 1, options, (f"register-{number}",)) as (folder, advance):
        if not folder.finished:
            solution = job.recipe.solver.solve(edges.select(edges.counts).as_graph(ids), start)
            save_round(folder.path, edges, ids, solution)
            for note in solution.notes:
                job.note(f"round {number}: {note}")
            advance(1)
    return load_round(job.path(name))


def save_round(folder: Path, edges: Edges, vertex_ids: NDArray[np.generic], solution: Solution) -> None:
    """Write what a solve found: its poses, and its edges with their weights and residuals."""
    artifacts.save_solution(folder / "solution.npz", solution)
    solved = with_residuals(edges, solution.world_from_cam, solution.weights)
    artifacts.save_edges(folder / EDGES, solved, vertex_ids)


def load_round(folder: Path) -> Round:
    """The round that `save_round` wrote."""
    solution = artifacts.load_solution(folder / "solution.npz")
    return Round(*artifacts.load_edges(folder / EDGES), solution.world_from_cam, solution)


def vertex_ids(source: Source) -> NDArray[np.generic]:
    """The frames as the source names them: numbers, or words."""
    return np.array([frame.frame_id for frame in source.frames])


def judge_edges(job: Job, last: Round, number: int) -> Round:
    """Round `number`, the last, with the verdict of the diagnosis on each of its edges."""
    with job.stage("diagnose", "diagnosis", 1, job.recipe.diagnosis, (f"solve-{number}",)) as (folder, advance):
        if not folder.finished:
            judged = diagnose(last.graph, job.recipe.diagnosis).put_into(last.edges)
            artifacts.save_edges(folder.path / EDGES, judged, last.vertex_ids)
            advance(1)
    return replace(last, edges=artifacts.load_edges(job.path("diagnose") / EDGES)[0])


def fuse(job: Job, frames: Sequence[Frame], world_from_cam: Floats, number: int) -> dict[str, Path]:
    """The PLY file of each model, by its name, from the poses (N, 4, 4) that follow from round `number`, the last."""
    last, files = f"solve-{number}", {}
    for row, fuser in enumerate(job.recipe.fusion):
        name, options = f"fuse-{row}", fuser if job.tracked is None else (fuser, len(frames))
        with job.stage(name, f"fusion {row + 1}", len(frames), options, ("source", last)) as (folder, advance):
            if not folder.finished:
                model = fuser.fuse(frames, world_from_cam, advance)
                write_ply(folder.path / f"{model.name}.ply", model)
                for note in model.notes:
                    job.note(note)
        (path,) = job.path(name).glob("*.ply")
        files[path.stem] = path
    return files


def evaluate(job: Job, source: Source, rounds: Sequence[Round], workers: Workers) -> ScoreTable | None:
    """The score tables of the true poses (where there are any) and of every round."""
    if not job.recipe.evaluation.tables:
        return None
    if not job.scoring:
        job.note("the scores are not measured again after an edit: hodge run, as before, measures them")
        return None
    truth, sets = true_poses(source), pose_sets(rounds)
    reference = "truth" if has_truth(source) else "result"
    sets = {"truth": truth, **sets} if has_truth(source) else sets
    inputs = ("clouds", _first_stage(job), *(f"solve-{number}" for number in range(1, len(rounds))))
    scale = float(job.recipe.scale)
    with job.stage("evaluate", "evaluation", 1, job.recipe.evaluation, inputs) as (folder, advance):
        if not folder.finished:
            table = scaled_score_table(job.path("clouds"), sets, reference, workers, scale, folder.path / "scaled")
            artifacts.save_arrays(
                folder.path / "scores.npz",
                {f"{g.kind}_{part}": getattr(g, part) for g in table.graphs for part in ("pairs", "distances_m")},
            )
            advance(1)
    arrays = artifacts.load_arrays(job.path("evaluate") / "scores.npz")
    graphs = tuple(
        GraphScores(kind, arrays[f"{kind}_pairs"], arrays[f"{kind}_distances_m"], scale) for kind in GRAPH_KINDS
    )
    return ScoreTable(tuple(sets), reference, graphs)
