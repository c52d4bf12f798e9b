"""A run's artifacts into its recording: every stage, in the order of the run."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from hodge_pipeline import artifacts, binding, yaml_file
from hodge_pipeline.evaluation.scores import ScoreTable
from hodge_pipeline.evaluation.trajectory import absolute_error
from hodge_pipeline.fusion.ply import read_ply
from hodge_pipeline.job import Job
from hodge_pipeline.recording.recorder import Recorder
from hodge_pipeline.rounds import Round, has_truth, pose_sets, true_poses
from hodge_pipeline.types import Candidates, CloudSet, Floats, Source

FILE = "recording.rrd"


def record(
    job: Job, source: Source, rounds: Sequence[Round], models: dict[str, Path], scores: ScoreTable | None
) -> None:
    """Write `recording.rrd`; with the level `off` there is none."""
    options = job.recipe.recording
    if options.level == "off":
        return
    with job.stage("record", "recording", 4 + len(rounds), options, tuple(job.keys)) as (folder, advance):
        if not folder.finished:
            recorder = Recorder(folder.path, job.workspace.identity, options=options, rounds=len(rounds) - 1)
            notes = [*recorder.frames(source.name, source.frames, source.notes)]
            advance(1)
            notes += recorder.clouds(source.frames, CloudSet.open(job.path("clouds")))
            advance(1)
            notes += _record_poses(recorder, source, rounds)
            for number in range(1, len(rounds)):
                notes += _record_round(recorder, source, rounds, number)
                advance(1)
            for path in models.values():
                notes += recorder.model(read_ply(path))
            advance(1)
            notes += _record_evaluation(recorder, source, rounds, scores)
            log = (job.workspace.folder / "log.txt").read_text("utf-8").splitlines()
            recorder.text(yaml_file.dump(binding.unbind(job.recipe)), log)
            merged = recorder.finish(folder.path / FILE)
            for note in (*notes, *(merged.notes if merged else ())):
                job.note(note)
            advance(1)
    artifacts.link_or_copy(job.path("record") / FILE, job.workspace.folder / FILE)


def _record_poses(recorder: Recorder, source: Source, rounds: Sequence[Round]) -> tuple[str, ...]:
    """The truth is laid onto the result, so that the two are seen to differ and nothing else."""
    notes = recorder.poses("odometry", rounds[0].world_from_cam, source.frames)
    truth, result = true_poses(source), rounds[-1]
    if has_truth(source) and result.solution is not None:
        laid = absolute_error(truth, np.where(np.isfinite(truth), result.world_from_cam, np.nan)).aligned
        notes += recorder.poses("truth", laid, source.frames)
    return notes


def _record_round(recorder: Recorder, source: Source, rounds: Sequence[Round], number: int) -> tuple[str, ...]:
    before, this = rounds[number - 1], rounds[number]
    assert this.solution is not None
    rejected = Candidates(this.rejected_pairs, this.rejected_reasons, np.full(len(this.rejected_pairs), np.nan))
    verdicts = None if this.verdicts is None else this.verdicts.verdict.tolist()
    first = sum(1 + len(one.solution.history) for one in rounds[1:number] if one.solution is not None)
    return recorder.edges(
        number, this.graph, before.world_from_cam, rejected=rejected, verdicts=verdicts
    ) + recorder.solution(
        number, this.graph, before.world_from_cam, this.solution, source.frames, first_iteration=first
    )


def _record_evaluation(
    recorder: Recorder, source: Source, rounds: Sequence[Round], scores: ScoreTable | None
) -> tuple[str, ...]:
    truth = true_poses(source)
    per_frame: dict[str, Floats] = {}
    if has_truth(source):
        for name, poses in pose_sets(rounds).items():
            per_frame[f"error_m/{name}"] = absolute_error(poses, truth).per_frame_m
    bars, tables = {}, {}
    if scores is not None:
        for graph in scores.graphs:
            bars[f"score_{graph.kind}"] = graph.mean_score
            rows = zip(scores.names, graph.mean_score, graph.mean_distance_m * 1000, strict=True)
            lines = [f"| {name} | {score:.4f} | {distance:.2f} |" for name, score, distance in rows]
            tables[f"Scores, {graph.kind} graph"] = "\n".join(["| poses | score | d, mm |", "|---|---|---|", *lines])
    return recorder.evaluation(source.frames, per_frame=per_frame, bars=bars, tables=tables)
