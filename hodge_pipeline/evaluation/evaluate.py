"""The scores of the poses of a run's rounds."""

from __future__ import annotations

from collections.abc import Sequence

from hodge_pipeline.evaluation.scores import ScoreTable, score_table
from hodge_pipeline.scene import Round, has_truth, pose_sets, true_poses
from hodge_pipeline.stages import Step, Steps, Workers
from hodge_pipeline.types import CloudSet, Floats, Source


def score_rounds(
    source: Source, clouds: CloudSet, rounds: Sequence[Round], scale: float, steps: Steps, workers: Workers
) -> ScoreTable:
    """The scores of every round and of the true poses where there are any, which then are the reference.

    Lengths of the scores are multiplied by `scale`.
    """
    sets = pose_sets(rounds, source)
    sets = {"truth": true_poses(source), **sets} if has_truth(source) else sets
    reference = "truth" if has_truth(source) else "result"
    return steps.step(evaluate, clouds, sets, reference, scale, title="evaluation", workers=workers)


def evaluate(
    clouds: CloudSet, sets: dict[str, Floats], reference: str, scale: float, *, workers: Workers, step: Step
) -> ScoreTable:
    """Step: the scores of named sets of poses (K, 4, 4), on the pairs that overlap under the `reference` one."""
    return score_table(clouds.folder, sets, reference, workers, scale=scale)
