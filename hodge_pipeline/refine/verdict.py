"""The end of a run that started from given poses: measured against them, decided, spread over all frames, written."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hodge_pipeline import registry
from hodge_pipeline.errors import RecipeError
from hodge_pipeline.evaluation.scores import SIGMA_M, edge_distances
from hodge_pipeline.pairs.held_out import held_out_pairs
from hodge_pipeline.refine.guard import Decision, Measure, decide
from hodge_pipeline.refine.uncertainty import change, mean_chi2
from hodge_pipeline.rounds.one_round import Work
from hodge_pipeline.scene import Round
from hodge_pipeline.sources.inspect import guesses
from hodge_pipeline.stages import Step, Workers
from hodge_pipeline.types import CloudSet, Floats, Ints, Source, Trajectory
from hodge_pipeline.types.notes import Note

CHI2_TOLERANCE = 0.02
"""Of the start's: the solver minimises a robust cost, not this one."""
SIGMAS = 3.0
"""Standard errors of the mean change of the score that its own noise may reach."""
LEAST_TOLERANCE = 0.002
"""Of the score: what a fraction of a millimetre does."""

LEAST_JOINED = 0.2
"""Of the key frames: the least that overlap with another one where the given poses are of these frames."""


@dataclass(frozen=True)
class Refined:
    """What a refinement came to: the decision, poses (N, 4, 4) of all frames, and the name, in the run folder, of the
    written file of poses, or of the folder; empty where nothing is written.
    """

    decision: Decision
    world_from_cam: Floats
    file: str


def finish(work: Work, folder: Path, rounds: Sequence[Round]) -> Refined:
    """The decision on the last round's poses, and `refined.<suffix>` in the run folder.

    Without an edge there is nothing to decide: nothing is written but the report.
    """
    last, key_frames = rounds[-1], work.scene.key_frames
    decision = _decision(work, rounds, key_frames.world_from_key)
    work.steps.note(Note("guard", detail=decision.reason))
    poses = key_frames.first if decision.keeps_input else key_frames.expand(last.world_from_cam)
    file = None if decision.outcome == "nothing" else _write(work, folder, decision, last)
    return Refined(decision, poses, "" if file is None else file.name)


def _decision(work: Work, rounds: Sequence[Round], before: Floats) -> Decision:
    last = rounds[-1]
    if not last.graph.edge_count or last.solution is None:
        rejected = ", ".join(f"{count} {reason}" for reason, count in last.edges.rejected_counts.items())
        return Decision("nothing", f"no edge joins two frames ({rejected or 'no pair overlaps'}): nothing was refined")
    if not (last.solution.weights > 0).any():
        return Decision("nothing", f"the solver rejected all {last.graph.edge_count} edges: nothing was refined")
    joined = len(np.unique(last.graph.edges))
    if joined < LEAST_JOINED * last.graph.vertex_count:
        found = f"{joined} of {last.graph.vertex_count} key frames overlap with another one"
        return Decision("nothing", f"under the given poses only {found}: are they the poses of these frames?")
    measures = [*_held_out(work, rounds, before)]
    chi2 = [mean_chi2(last.graph, last.solution.weights, poses) for poses in (before, last.world_from_cam)]
    measures.append(chi2_measure(*chi2))
    return decide(measures, change(last.graph, last.solution, before), force=work.recipe.guard.force)


def chi2_measure(before: float, after: float) -> Measure:
    """The mean χ² of the edges, which may grow by a little."""
    return Measure("edge chi2, mean", before, after, tolerance=CHI2_TOLERANCE * before)


def _held_out(work: Work, rounds: Sequence[Round], before: Floats) -> list[Measure]:
    """The score of the pairs kept out of every round; its tolerance is its own standard error."""
    pairs, after = held_out_pairs(rounds), rounds[-1].world_from_cam
    if not len(pairs):
        work.steps.note(Note("nothing held out", 0))
        return []
    scale = float(work.recipe.scale)
    distances = work.steps.step(
        held_out_distances_m, work.scene.clouds, pairs, np.stack([before, after]), scale, title="guard",
        workers=work.workers,
    )  # fmt: skip
    scores = np.exp(-distances / (scale * SIGMA_M))
    error = float((scores[1] - scores[0]).std() / np.sqrt(len(pairs)))
    tolerance = max(SIGMAS * error, LEAST_TOLERANCE)
    mean_mm, mean = distances.mean(axis=1) * 1000, scores.mean(axis=1)
    apart = f"{mean_mm[0]:.3g} mm apart before, {mean_mm[1]:.3g} mm after"
    work.steps.note(Note("held out", len(pairs), apart))
    return [Measure("score of held-out edges", float(mean[0]), float(mean[1]), "higher", tolerance, is_held_out=True)]


def held_out_distances_m(
    clouds: CloudSet, pairs: Ints, pose_sets: Floats, scale: float, *, workers: Workers, step: Step
) -> Floats:
    """Step: how far apart (S, P) the clouds of pairs lie, metres, under sets of poses (S, K, 4, 4)."""
    assert clouds.folder is not None
    return edge_distances(clouds.folder, pairs, pose_sets, workers, scale=scale)


def _write(work: Work, folder: Path, decision: Decision, last: Round) -> Path | None:
    """`refined.<suffix>`: the input's own bytes where it is kept, else its form with the refined poses."""
    given = work.scene.given
    if given is None:
        return None
    original = given.path
    reader = guesses(original)[0].name
    try:
        rewriter = registry.load("rewriters", reader)()
    except RecipeError:
        rewriter = None
    if decision.keeps_input:
        if rewriter is not None:
            return Path(rewriter.copy(folder, original))
        out = folder / f"refined{original.suffix}"
        shutil.copyfile(original, out)
        return out
    moved = given.expand(work.scene.key_frames, last.world_from_cam)
    refined = Trajectory(given.trajectory.stamps_s, moved)
    if rewriter is not None:
        return Path(rewriter.rewrite(folder, original, refined))
    work.steps.note(Note("other format", detail=original.suffix or "a folder"))
    registry.load("writers", "tum")().write(folder / "refined.tum", Source("refined", original, trajectory=refined))
    return folder / "refined.tum"
