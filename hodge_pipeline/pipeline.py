"""The method on one screen: first poses; pairs proposed, registered, judged and solved, again and again; fusion."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import chain
from pathlib import Path

from hodge_pipeline.complex.parts import decompose, one_form
from hodge_pipeline.errors import GraphError
from hodge_pipeline.evaluation.scores import ScoreTable, score_rounds
from hodge_pipeline.executors.dask import open_workers
from hodge_pipeline.fusion.fuse import fuse_all
from hodge_pipeline.recipe.schema import Recipe
from hodge_pipeline.recording.run import Recording
from hodge_pipeline.refine import given_poses
from hodge_pipeline.refine.given_poses import Refined
from hodge_pipeline.rounds.all_frames import pose_all_frames
from hodge_pipeline.rounds.by_hand import edited_rounds
from hodge_pipeline.rounds.one_round import Registered, Work
from hodge_pipeline.rounds.suggested import suggested_rounds
from hodge_pipeline.run_folder import begin
from hodge_pipeline.scene import Round, Scene
from hodge_pipeline.sources.measured_edges import measured_edges
from hodge_pipeline.start.known_positions import known_fixes
from hodge_pipeline.store.store import Store
from hodge_pipeline.types import Floats, Source, ViewGraph
from hodge_pipeline.types.notes import Note, notes_of


@dataclass(frozen=True)
class Job:
    """What one run computes from; `again`: after an edit, when a person waits, without what takes long."""

    recipe: Recipe
    source: Source
    store: Store
    folder: Path
    dask: str | None = None
    again: bool = False


@dataclass(frozen=True)
class Computed:
    """What one run has computed; `poses (N, 4, 4)` are those of all frames."""

    scene: Scene
    rounds: tuple[Round, ...]
    scores: ScoreTable | None
    refined: Refined | None
    poses: Floats
    models: Mapping[str, Path]


def compute(job: Job, recording: Recording) -> Computed:
    """The paper's algorithm, and what follows it."""
    recipe, store = job.recipe, job.store
    with open_workers(recipe.executor, job.dask) as workers:
        scene = recipe.start.begin(job.source, recipe.clouds, store, workers)
        store.step(begin, scene.whole, scene.key_frames, scene.first, title="frames")
        recording.begin(scene.source, scene.clouds, scene.first)
        fixes = known_fixes(scene, recipe.positions, store)
        work = Work(recipe, store, scene, measured(job, scene), workers, fixes)
        rounds = [scene.first]
        edited = edited_rounds(work, job.folder, rounds)
        registered = chain(proposed_rounds(work, rounds), suggested_rounds(work, rounds), edited)
        for solved in map(partial(consistent, work), registered):
            rounds.append(solved)
            recording.round(len(rounds) - 1, solved)
        recording.diagnosis(rounds[-1])
        scores = score(job, work, rounds)
        recording.scores(scores)
        refined = given_poses.finish(work, job.folder, rounds) if scene.is_given else None
        poses = final_poses(work, rounds[-1], refined)
    models = fuse_all(recipe.fusion, scene, poses, store, keys_only=job.again and rounds[-1].edited)
    recording.models(models)
    return Computed(scene, tuple(rounds), scores, refined, poses, models)


def proposed_rounds(work: Work, rounds: Sequence[Round]) -> Iterator[Registered]:
    """The outer iterations: pairs proposed and registered from the last of `rounds`, which the caller extends."""
    for number in range(1, work.recipe.outer_iterations + 1):
        before = rounds[-1] if number > 1 else work.placed_first()
        yield work.register(number, work.propose(number, before), before)


def consistent(work: Work, registered: Registered) -> Round:
    """The poses consistent with a round's edges: the verdict on each, their complex, ω on it, its parts, the solve."""
    judged = work.judge(registered)
    viewing_graph, energies = judged.graph(work.scene.first.vertex_ids), None
    try:
        complex_ = work.recipe.complex.of(viewing_graph, work.scene.clouds, judged.start)
        omega = one_form(viewing_graph, judged.start)
        energies = decompose(complex_, omega).energies(complex_.counts)
    except GraphError as error:  # the poses do not depend on it
        work.steps.note(Note("no decomposition", detail=f"{judged.name}: without its decomposition: {error}"))
    return work.solve(judged, energies)


def measured(job: Job, scene: Scene) -> ViewGraph:
    """The edges that come measured, over the key frames: they join every round's graph as they are."""
    graph, notes = measured_edges(scene.source, job.recipe.measured)
    job.store.note(*notes_of("measured", notes))
    return graph


def score(job: Job, work: Work, rounds: list[Round]) -> ScoreTable | None:
    """The scores of every round, where they are wished for."""
    if not job.recipe.evaluation.tables:
        return None
    if job.again and rounds[-1].edited:
        job.store.note(Note("scores of before"))
        return None
    return score_rounds(work.scene.source, work.scene.clouds, rounds, work.scale, job.store, work.workers)


def final_poses(work: Work, last: Round, refined: Refined | None) -> Floats:
    """The poses (N, 4, 4) of all frames: those that follow from the last round, or that its guard kept."""
    if refined is not None:
        return refined.world_from_cam
    return pose_all_frames(work.scene, last.world_from_cam, work.steps, work.workers, work.scale)
