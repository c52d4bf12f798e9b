"""The method on one screen: start, then propose, register and solve until consistent; judge, refine, fuse."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

from hodge_pipeline.complex.parts import decompose, energies, one_form
from hodge_pipeline.errors import GraphError, RecipeError, SourceError
from hodge_pipeline.evaluation.evaluate import score_rounds
from hodge_pipeline.evaluation.scores import ScoreTable
from hodge_pipeline.executors.dask import open_workers
from hodge_pipeline.fusion.fuse import fuse_all
from hodge_pipeline.pairs.edits import listed_edges
from hodge_pipeline.recipe import binding
from hodge_pipeline.recipe.recipe_file import recipe_names
from hodge_pipeline.recipe.scale import with_scale
from hodge_pipeline.recipe.schema import Recipe, load_recipe, with_source
from hodge_pipeline.recording.run import Recording
from hodge_pipeline.refine import verdict
from hodge_pipeline.refine.poses import refine_poses
from hodge_pipeline.refine.verdict import Refined
from hodge_pipeline.report import run_files
from hodge_pipeline.rounds.all_frames import pose_all_frames
from hodge_pipeline.rounds.by_hand import edited_rounds
from hodge_pipeline.rounds.one_round import Registered, Work
from hodge_pipeline.rounds.suggested import suggested_rounds
from hodge_pipeline.run_folder import Run, begin, check_layout, end, opening_of
from hodge_pipeline.scene import Round, Scene
from hodge_pipeline.solvers.positions import Fixes
from hodge_pipeline.sources.measured_edges import measured_edges
from hodge_pipeline.sources.opening import Fingerprints, changed_since, fingerprints, open_with_reader, remembered
from hodge_pipeline.start.known_positions import fixes_of, known_positions
from hodge_pipeline.start.truth import with_truth
from hodge_pipeline.store.log import logging_to
from hodge_pipeline.store.progress import Watcher
from hodge_pipeline.store.store import Store
from hodge_pipeline.store.workspace import RECIPE_FILE, Workspace, disk_errors
from hodge_pipeline.types import Floats, Source, ViewGraph
from hodge_pipeline.types.notes import Note, notes_of


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

    A `source` may be opened already; a run of frames that are in memory cannot be resumed by another process.
    `live` is the address of a Rerun viewer that shows the run as it happens; `dask` that of a Dask scheduler whose
    workers see the same files, and which is trusted to run code here. Input that changes during the run is noted at its
    end: by sizes and times, and with `strict` by hashes of every file.
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
        disk_errors(folder),
        logging_to(folder / "log.txt"),
    ):
        return _Job(recipe, workspace, Store(workspace.steps, watcher), live, dask, opened, strict=strict).run()


def solve_again(folder: Path | str, *, watcher: Watcher | None = None, dask: str | None = None) -> Run:
    """Solve and fuse a finished run once more, with the edits in its folder, and bring all that it left up to date.

    Nothing is registered and no score is measured again: `run` with the same recipe does that. `dask` is as of `run`.
    Raises `HodgeError`.
    """
    folder = Path(folder)
    listed_edges(folder)
    check_layout(folder)
    recipe = load_recipe(str(folder / RECIPE_FILE))
    with (
        Workspace.reopen(folder, binding.unbind(recipe)) as workspace,
        disk_errors(folder),
        logging_to(folder / "log.txt"),
    ):
        return _Job(recipe, workspace, Store(workspace.steps, watcher), dask=dask, again=True).run()


@dataclass(frozen=True)
class _Job:
    """One run in progress; `again`: after an edit, when a person waits, without what takes long."""

    recipe: Recipe
    workspace: Workspace
    store: Store
    live: str | None = None
    dask: str | None = None
    opened: Source | None = None
    again: bool = False
    strict: bool = False

    def run(self) -> Run:
        """The finished run."""
        source, before = self.read()
        job = _Job(**{**vars(self), "recipe": with_scale(self.recipe, source, self.store)})
        with ExitStack() as pool:
            workers = pool.enter_context(open_workers(job.recipe.executor, job.dask))
            with Recording(job.store, job.workspace.folder, job.recipe, source, job.live) as recording:
                scene = job.recipe.start.begin(source, job.recipe.clouds, job.store, workers)
                job.store.step(begin, *opening_of(scene), title="frames")
                recording.begin(scene.source, scene.clouds, scene.first)
                work = Work(job.recipe, job.store, scene, job.measured(scene), workers, job.fixes(scene))
                rounds, scores = job.compute(work, recording)
                refined = verdict.finish(work, job.workspace.folder, rounds) if scene.is_given else None
                poses = job.refine(work, rounds[-1], refined)
                pool.close()  # fusing needs their memory
                keys_only = job.again and rounds[-1].edited
                models = fuse_all(job.recipe.fusion, scene, poses, job.store, keys_only=keys_only)
                recording.models(models)
        self.store.note(*changed_since(before, strict=self.strict))
        return job.finish(scene, rounds, poses, models, scores, refined)

    def read(self) -> tuple[Source, Fingerprints]:
        """The source, opened, and what its files are like now; its images stay on disk."""
        path = self.recipe.source.path
        if path is None:
            raise RecipeError("source.path: the recipe names no source: give one (--source PATH)")
        source, reader = (
            (self.opened, None) if self.opened else open_with_reader(path, self.recipe.source.reader, recipe_names())
        )
        if not source.frames:
            raise SourceError(f"{path}: has no frames to register: give a sequence with depth or clouds")
        self.store.note(*notes_of("reader", source.notes))
        if len(source.frames) == 1:
            self.store.note(Note("single frame", detail=str(path)))
        prints = fingerprints(source.files, strict=self.strict)
        source = remembered(source, reader, self.store, prints)
        return with_truth(source, self.recipe.evaluation.truth, self.store), prints

    def measured(self, scene: Scene) -> ViewGraph:
        """The edges that come measured, over the key frames: they join every round's graph as they are."""
        graph, notes = measured_edges(scene.source, self.recipe.measured)
        self.store.note(*notes_of("measured", notes))
        return graph

    def fixes(self, scene: Scene) -> Fixes | None:
        """Known positions of points of the key frames, None where there are none."""
        options = self.recipe.positions
        found = known_positions(scene.whole, options, self.store)
        return None if found is None else fixes_of(found, options, scene, self.store)

    def compute(self, work: Work, recording: Recording) -> tuple[list[Round], ScoreTable | None]:
        """The rounds and their scores: the paper's algorithm."""
        rounds, before = [work.scene.first], work.placed_first()
        for number in range(1, self.recipe.outer_iterations + 1):
            proposed = work.propose(number, before)
            registered = work.register(number, proposed, before)
            rounds.append(before := self.consistent(work, registered))
            recording.round(number, rounds[-1])
        for more in chain(suggested_rounds(work, rounds), edited_rounds(work, self.workspace.folder, rounds)):
            rounds.append(self.consistent(work, more))
            recording.round(len(rounds) - 1, rounds[-1])
        rounds[-1] = work.judge(rounds[-1])
        recording.diagnosis(rounds[-1])
        scores = self.score(work, rounds)
        recording.scores(scores)
        return rounds, scores

    def consistent(self, work: Work, registered: Registered) -> Round:
        """The poses consistent with a round's edges: the complex of their graph, ω on it, its parts, the solve."""
        graph = registered.graph(work.scene.first.vertex_ids)
        found = None
        try:
            complex_ = self.recipe.complex.of(graph, work.scene.clouds, registered.start)
            omega = one_form(graph, registered.start)
            found = energies(complex_, decompose(complex_, omega))
        except GraphError as error:  # the poses do not depend on it
            self.store.note(Note("no decomposition", detail=f"{registered.name}: without its decomposition: {error}"))
        return work.solve(registered, graph, found)

    def score(self, work: Work, rounds: list[Round]) -> ScoreTable | None:
        """The scores of every round, where they are wished for."""
        if not self.recipe.evaluation.tables:
            return None
        if self.again and rounds[-1].edited:
            self.store.note(Note("scores of before"))
            return None
        scale = float(self.recipe.scale)
        return score_rounds(work.scene.source, work.scene.clouds, rounds, scale, self.store, work.workers)

    def refine(self, work: Work, last: Round, refined: Refined | None) -> Floats:
        """The final poses (N, 4, 4) of all frames: those that follow from the last round, or that its guard kept,
        refined where the recipe says how.
        """
        scene = work.scene
        poses = (
            pose_all_frames(scene, last.world_from_cam, self.store, work.workers)
            if refined is None
            else refined.world_from_cam
        )
        if self.recipe.refiner is None:
            return poses
        title, total = "refine", len(poses)
        return self.store.step(refine_poses, self.recipe.refiner, scene.whole, poses, title=title, total=total)

    def finish(
        self,
        scene: Scene,
        rounds: list[Round],
        poses: Floats,
        models: Mapping[str, Path],
        scores: ScoreTable | None,
        refined: Refined | None,
    ) -> Run:
        """What the run leaves in its folder."""
        folder, recipe = self.workspace.folder, self.recipe
        report = run_files.write(folder, recipe, self.store, scene, rounds, poses, models, scores, refined)
        ending = self.store.step(end, poses, report, refined, title="report")
        return Run(
            self.workspace.folder, scene.whole, scene.key_frames, scene.clouds, tuple(rounds), poses, models, scores,
            ending,
        )  # fmt: skip
