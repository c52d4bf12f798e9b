"""A run's artifacts into its recording: each stage's part as soon as the stage is done, merged at the end."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from types import TracebackType

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.evaluation.scores import ScoreTable
from hodge_pipeline.evaluation.trajectory import absolute_error
from hodge_pipeline.fusion.ply import read_ply
from hodge_pipeline.recipe import binding, yaml_file
from hodge_pipeline.recording.live import Live
from hodge_pipeline.recording.merge import find_parts, merge_parts
from hodge_pipeline.recording.recorder import APPLICATION, Recorder
from hodge_pipeline.scene import Round, has_truth, pose_sets, true_poses
from hodge_pipeline.store import artifacts
from hodge_pipeline.store.job import RECORDING, Job, Unfinished, log
from hodge_pipeline.types import CloudSet, Edges, Floats, Ints, Source
from hodge_pipeline.types.edges import HELD_OUT

FILE = "recording.rrd"
Notes = tuple[str, ...]


class Recording:
    """The recording of a run in progress: a context that ends with `recording.rrd` in the run folder.

    Each method records one stage, under a key of its own: a resumed run records only what it computes again. Where the
    run is stopped or fails, what was recorded so far is merged and the error goes on. With the level `off` nothing is
    written.
    """

    def __init__(self, job: Job, source: Source) -> None:
        self._job, self._source = job, source
        self._stages: list[str] = []
        self._rounds: list[Round] = []
        self._live = None if job.live is None else Live(job.live, APPLICATION, job.workspace.identity)

    def __enter__(self) -> Recording:
        source = self._source
        self._part("frames", ("source",), lambda to: to.frames(source.name, source.frames, source.notes))
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._job.recipe.recording.level == "off":
            return
        if error is None:
            self._finish()
        elif not (isinstance(error, Unfinished) and error.stale):
            self._rescue()
        if self._live is not None:
            self._live.close()

    def clouds(self, clouds: CloudSet) -> None:
        """The frames' clouds."""
        self._part("clouds", ("clouds",), lambda to: to.clouds(self._source.frames, clouds))

    def first_poses(self, first: Round) -> None:
        """The poses that the run starts from."""
        self._rounds = [first]
        self._part(
            first.name, (first.name,), lambda to: to.poses(first.name, first.world_from_cam, self._source.frames)
        )

    def registration(self, number: int, registered: Edges, before: Floats, clouds: CloudSet) -> None:
        """What registration found in outer round `number`, from the poses before it."""
        registered = registered.select(registered.status != HELD_OUT)
        i, j = registered.pairs.T
        guesses = se3.inverse(before[i]) @ before[j]
        self._part(
            f"registration-{number}",
            (f"register-{number}",),
            lambda to: to.registration(number, registered, guesses, clouds),
            self._job.recipe.acceptance,
        )

    def round(self, number: int, this: Round) -> None:
        """The edges of outer round `number`, the pairs that became none, and the solve."""
        self._rounds.append(this)
        rounds = tuple(self._rounds)
        self._part(f"round-{number}", (f"solve-{number}",), lambda to: _record_round(to, self._source, rounds, number))

    def diagnosis(self, last: Round) -> None:
        """The last round's edges with the verdict on each."""
        self._rounds[-1] = last
        edges = last.graph_edges
        self._part(
            "diagnosis",
            ("diagnose",),
            lambda to: to.diagnosis(last.graph, last.world_from_cam, edges.verdict, edges.probability, edges.why),
        )

    def scores(self, scores: ScoreTable | None) -> None:
        """The errors of the frames and the score tables."""
        inputs = (f"solve-{len(self._rounds) - 1}", *(["evaluate"] if scores is not None else []))
        rounds = tuple(self._rounds)
        self._part("evaluation", inputs, lambda to: _record_evaluation(to, self._source, rounds, scores))

    def models(self, models: dict[str, Path]) -> None:
        """The fused models; of several the last is seen."""
        inputs = tuple(f"fuse-{row}" for row in range(len(models)))
        if models:
            poses = self._rounds[-1].world_from_cam
            clouds = CloudSet.open(self._job.path("clouds"))
            self._part(
                "model",
                inputs,
                lambda to: tuple(n for path in models.values() for n in to.model(read_ply(path), clouds, poses)),
            )

    def _part(self, name: str, inputs: tuple[str, ...], write: Callable[[Recorder], Notes], *options: object) -> None:
        job, stage = self._job, f"record-{name}"
        if job.recipe.recording.level == "off":
            return
        with job.stage(stage, RECORDING, 1, (job.recipe.recording, *options), inputs) as (folder, advance):
            if not folder.finished:
                for note in write(self._recorder(folder.path)):
                    job.note(note)
                advance(1)
        self._stages.append(stage)
        if self._live is not None:
            self._live.show(self._parts())

    def _recorder(self, folder: Path) -> Recorder:
        job = self._job
        rounds = job.recipe.outer_iterations + job.recipe.suggestions.rounds
        return Recorder(folder, job.workspace.identity, options=job.recipe.recording, rounds=rounds)

    def _finish(self) -> None:
        job = self._job
        with job.stage("record", RECORDING, 1, job.recipe.recording, tuple(self._stages)) as (folder, advance):
            if not folder.finished:
                for note in self._merge(folder.path, folder.path / FILE):
                    job.note(note)
                advance(1)
        artifacts.link_or_copy(job.path("record") / FILE, job.workspace.folder / FILE)

    def _rescue(self) -> None:
        """Merge what there is; an error of this is logged, so that the one that stopped the run is seen."""
        folder = self._job.workspace.folder
        try:
            with tempfile.TemporaryDirectory(dir=folder, prefix=".recording-") as scratch:
                self._merge(Path(scratch), folder / FILE)
        except Exception as error:
            log.warning("the recording could not be merged: %s", error)

    def _merge(self, folder: Path, out: Path) -> Notes:
        """Truth, recipe and log, which belong to the run as a whole, then all parts as one file."""
        job, recorder = self._job, self._recorder(folder)
        notes = _record_truth(recorder, self._source, self._rounds)
        lines = (job.workspace.folder / "log.txt").read_text("utf-8").splitlines()
        recorder.text(yaml_file.dump(binding.unbind(job.recipe)), lines)
        parts = self._parts(folder)
        if self._live is not None:
            self._live.show(parts)
        return notes + merge_parts(parts, out, APPLICATION, job.workspace.identity).notes

    def _parts(self, *others: Path) -> list[Path]:
        folders = [*(self._job.path(stage) for stage in self._stages), *others]
        return [part for folder in folders for part in find_parts(folder)]


def _record_truth(recorder: Recorder, source: Source, rounds: Sequence[Round]) -> Notes:
    """The truth, laid onto the last poses, so that the two are seen to differ and nothing else."""
    if not rounds or not has_truth(source):
        return ()
    truth = true_poses(source)
    laid = absolute_error(truth, np.where(np.isfinite(truth), rounds[-1].world_from_cam, np.nan)).aligned
    return recorder.poses("truth", laid, source.frames)


def _record_round(recorder: Recorder, source: Source, rounds: Sequence[Round], number: int) -> Notes:
    before, this = rounds[number - 1], rounds[number]
    assert this.solution is not None
    first = sum(1 + len(one.solution.history) for one in rounds[1:number] if one.solution is not None)
    return recorder.edges(number, this.graph, before.world_from_cam, rejected=this.rejected) + recorder.solution(
        number, this.graph, before.world_from_cam, this.solution, source.frames, first_iteration=first
    )


def _record_evaluation(recorder: Recorder, source: Source, rounds: Sequence[Round], scores: ScoreTable | None) -> Notes:
    truth = true_poses(source)
    per_frame: dict[str, Floats] = {}
    if has_truth(source):
        for name, poses in pose_sets(rounds).items():
            per_frame[f"error_m/{name}"] = absolute_error(poses, truth).per_frame_m
    bars, tables = {}, {}
    if scores is not None:
        for graph in scores.graphs:
            bars[f"score_{graph.kind}"] = graph.mean_score
            for name, scores_of_pairs in zip(scores.names, graph.scores, strict=True):
                if graph.kind == scores.graphs[-1].kind and len(graph.pairs):
                    per_frame[f"score/{name}"] = mean_at_frames(graph.pairs, scores_of_pairs, len(source.frames))
            rows = zip(scores.names, graph.mean_score, graph.mean_distance_m * 1000, strict=True)
            lines = [f"| {name} | {score:.4f} | {distance:.2f} |" for name, score, distance in rows]
            tables[f"Scores, {graph.kind} graph"] = "\n".join(["| poses | score | d, mm |", "|---|---|---|", *lines])
    return recorder.evaluation(source.frames, per_frame=per_frame, bars=bars, tables=tables)


def mean_at_frames(pairs: Ints, values: Floats, count: int) -> Floats:
    """The mean (count,) of the values (P,) of each frame's pairs (P, 2); NaN where it has none that is known."""
    known = np.isfinite(values)
    ends = pairs[known].ravel()
    total = np.bincount(ends, np.repeat(values[known], 2), minlength=count)
    number = np.bincount(ends, minlength=count)
    return np.where(number > 0, total / np.maximum(number, 1), np.nan)
