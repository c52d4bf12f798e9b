"""Record a run: each stage's part when the stage is done, all parts merged at the end."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.evaluation.scores import ScoreTable
from hodge_pipeline.evaluation.trajectory import absolute_error
from hodge_pipeline.recipe.recording_options import RecordingOptions
from hodge_pipeline.recipe.schema import Recipe
from hodge_pipeline.recording.live import Live
from hodge_pipeline.recording.merge import find_parts, merge
from hodge_pipeline.recording.recorder import Notes, Recorder
from hodge_pipeline.scene import FIRST, START, Round, given_poses, has_given, has_truth, pose_sets, true_poses
from hodge_pipeline.stages import Step, Steps
from hodge_pipeline.start.clouds import clouds as clouds_step
from hodge_pipeline.store import artifacts
from hodge_pipeline.store.log import log
from hodge_pipeline.store.progress import RECORDING
from hodge_pipeline.store.store import stored
from hodge_pipeline.store.workspace import LOG_FILE, RECIPE_FILE, RECORDING_FILE, RUN, identity_of
from hodge_pipeline.types import CloudSet, Floats, Ints, Source
from hodge_pipeline.types.axes import is_scanner
from hodge_pipeline.types.input_files import read_input_text
from hodge_pipeline.types.notes import notes_of
from hodge_pipeline.types.ply import read_model
from hodge_pipeline.types.text import markdown_table


class Recording:
    """The recording of a run in progress: a context that ends with `recording.rrd` in the run folder.

    Each method records one part, as a step of its own: a resumed run records only what it computes again. Where the run
    is stopped or fails, the parts so far are merged and the error goes on; before `begin` these are the frames of
    `source` with their clouds, if made. With the level `off` nothing is written.
    """

    def __init__(self, steps: Steps, folder: Path, recipe: Recipe, source: Source, live: str | None = None) -> None:
        self._steps, self._folder, self._recipe, self._source = steps, folder, recipe, source
        self._parts: list[Path] = []
        self._rounds: list[Round] = []
        self._clouds: CloudSet | None = None
        self._identity = identity_of(folder)
        self._live = None if live is None else Live(live, self._identity)

    def __enter__(self) -> Recording:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: object) -> None:
        if self._recipe.recording.level == "off":
            return
        if error is None:
            self._finish()
        else:
            self._rescue()
        if self._live is not None:
            self._live.close()

    def begin(self, source: Source, clouds: CloudSet, first: Round) -> None:
        """The frames that are registered, their clouds, and the poses that the run starts from."""
        self._record_frames(source, clouds)
        self._rounds, frames = [first], source.frames
        name, poses = first.name, first.world_from_cam
        name = FIRST if name == START and has_given(source) else name
        self._part("first_poses", (self._source, name, poses), lambda to: to.poses(name, poses, frames))

    def _record_frames(self, source: Source, clouds: CloudSet | None) -> None:
        self._source, self._clouds, frames = source, clouds, source.frames
        self._part("frames", (source,), lambda to: to.frames(source.name, frames, source.notes))
        if clouds is not None:
            self._part("clouds", (source, clouds), lambda to: to.clouds(frames, clouds))

    def _registration(self, number: int, this: Round) -> None:
        """What registration found in outer round `number`, from the poses before it."""
        if self._clouds is None or this.fresh is None or this.before is None or not len(this.fresh):
            return
        registered, before, clouds = this.edges.select(this.fresh), this.before, self._clouds
        guesses = se3.between(before, registered.pairs)
        inputs = (number, registered, guesses, clouds)
        self._part("registration", inputs, lambda to: to.registration(number, registered, guesses, clouds))

    def round(self, number: int, this: Round) -> None:
        """The registrations of outer round `number`, its edges, the pairs that became none, and the solve."""
        self._registration(number, this)
        self._rounds.append(this)
        rounds = tuple(self._rounds)
        inputs = (self._source, number, this, rounds[number - 1])
        self._part("round", inputs, lambda to: _record_round(to, self._source, rounds, number))

    def diagnosis(self, last: Round) -> None:
        """The last round's edges with the verdict on each."""
        self._rounds[-1] = last
        inputs = last.graph, last.world_from_cam, last.graph_edges
        self._part("diagnosis", inputs, lambda to: to.diagnosis(*inputs))

    def scores(self, scores: ScoreTable | None) -> None:
        """The errors of the frames and the score tables."""
        rounds = tuple(self._rounds)
        inputs = (self._source, [one.world_from_cam for one in rounds], scores)
        self._part("evaluation", inputs, lambda to: _record_evaluation(to, self._source, rounds, scores))

    def models(self, models: Mapping[str, Path]) -> None:
        """The fused models; of several the viewer shows the last."""
        assert self._clouds is not None
        clouds, poses = self._clouds, self._rounds[-1].world_from_cam
        if models:
            inputs = (list(models.values()), clouds, poses)
            self._part(
                "model",
                inputs,
                lambda to: tuple(n for path in models.values() for n in to.model(read_model(path), clouds, poses)),
            )

    def _part(self, name: str, inputs: tuple[Any, ...], write: Callable[[Recorder], Notes]) -> None:
        options = self._recipe.recording
        if options.level == "off":
            return
        self._parts += self._steps.step(
            record_part, inputs, options, title=RECORDING, name=f"record_{name}", write=write, recorder=self._recorder
        )
        if self._live is not None:
            self._live.show(self._parts)

    def _recorder(self, folder: Path) -> Recorder:
        rounds = self._recipe.outer_iterations + self._recipe.suggestions.rounds
        seen = self._clouds is not None and is_scanner(self._clouds)
        return Recorder(folder, self._identity, options=self._recipe.recording, rounds=rounds, is_scanner=seen)

    def _finish(self) -> None:
        merged = self._steps.step(
            merge_recording, self._parts, self._recipe.recording, title=RECORDING, merge=self._merge
        )
        artifacts.link_or_copy(merged, self._folder / RECORDING_FILE)

    def _rescue(self) -> None:
        """Merge the parts so far; an error is only logged, so that the one that stopped the run is raised."""
        try:
            if not self._parts:
                whole = len(self._source.frames)
                made = [found for found in stored(self._folder / RUN, clouds_step) if len(found) == whole]
                self._record_frames(self._source, made[-1] if made else None)
            with tempfile.TemporaryDirectory(dir=self._folder, prefix=".recording-") as scratch:
                self._merge(Path(scratch), self._folder / RECORDING_FILE)
        except Exception as error:
            log.warning("the recording could not be merged: %s", error)

    def _merge(self, folder: Path, out: Path) -> Notes:
        """Write all parts into `out`, with true and given poses, recipe and log; the notes of these."""
        recorder = self._recorder(folder)
        notes = _record_reference(recorder, self._source, self._rounds)
        lines = read_input_text(self._folder / LOG_FILE, errors="replace").splitlines()
        recorder.text(read_input_text(self._folder / RECIPE_FILE, errors="replace"), lines)
        parts = [*self._parts, *find_parts(folder)]
        if self._live is not None:
            self._live.show(parts)
        merge(parts, out, self._identity)
        return notes


def record_part(
    inputs: tuple[Any, ...],
    options: RecordingOptions,
    *,
    write: Callable[[Recorder], Notes],
    recorder: Callable[[Path], Recorder],
    step: Step,
) -> tuple[Path, ...]:
    """Step: the files of one part of the recording, which `inputs` and `options` decide and `write` writes."""
    step.note(*notes_of("recording", write(recorder(step.folder))))
    return tuple(find_parts(step.folder))


def merge_recording(
    parts: list[Path], options: RecordingOptions, *, merge: Callable[[Path, Path], Notes], step: Step
) -> Path:
    """Step: all parts as one file."""
    step.note(*notes_of("recording", merge(step.folder, step.folder / RECORDING_FILE)))
    return step.folder / RECORDING_FILE


def _record_reference(recorder: Recorder, source: Source, rounds: Sequence[Round]) -> Notes:
    """Record true and given poses, aligned to the last ones."""
    if not rounds:
        return ()
    named = {"truth": true_poses(source)} if has_truth(source) else {}
    named |= {START: given_poses(source)} if has_given(source) else {}
    notes: Notes = ()
    for name, poses in named.items():
        laid = absolute_error(poses, np.where(np.isfinite(poses), rounds[-1].world_from_cam, np.nan)).aligned
        notes += recorder.poses(name, laid, source.frames)
    return notes


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
        for name, poses in pose_sets(rounds, source).items():
            per_frame[f"error_m/{name}"] = absolute_error(poses, truth).per_frame_m
    tables = {}
    if scores is not None:
        for graph in scores.graphs:
            for name, scores_of_pairs in zip(scores.names, graph.scores, strict=True):
                if graph.kind == scores.graphs[-1].kind and len(graph.pairs):
                    per_frame[f"score/{name}"] = mean_at_frames(graph.pairs, scores_of_pairs, len(source.frames))
            rows = zip(scores.names, graph.mean_score, graph.mean_distance_m * 1000, strict=True)
            cells = [(name, f"{score:.4f}", f"{distance:.2f}") for name, score, distance in rows]
            tables[f"Scores, {graph.kind} graph"] = markdown_table(("poses", "score", "d, mm"), cells)
    return recorder.evaluation(source.frames, per_frame=per_frame, tables=tables)


def mean_at_frames(pairs: Ints, values: Floats, count: int) -> Floats:
    """The mean (count,) of the values (P,) of each frame's pairs (P, 2); NaN where it has none that is known."""
    known = np.isfinite(values)
    ends = pairs[known].ravel()
    total = np.bincount(ends, np.repeat(values[known], 2), minlength=count)
    number = np.bincount(ends, minlength=count)
    return np.where(number > 0, total / np.maximum(number, 1), np.nan)
