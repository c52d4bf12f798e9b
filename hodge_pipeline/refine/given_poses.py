"""The end of a run that refines given poses: measure the result against them, decide, write it for all frames."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from hodge_pipeline import registry, se3
from hodge_pipeline.complex.components import connected_components
from hodge_pipeline.errors import RecipeError
from hodge_pipeline.evaluation.difference import length
from hodge_pipeline.evaluation.scores import SIGMA_M
from hodge_pipeline.pairs.held_out import held_out_pairs
from hodge_pipeline.refine.against_images import against_images, first_of_steps
from hodge_pipeline.refine.conventions import explained
from hodge_pipeline.refine.given_noise import without_noise
from hodge_pipeline.refine.guard import SCORE_TOLERANCE, Decision, Measure, decide, mean_noise
from hodge_pipeline.refine.jumps import apart_m, jump_note, sure_jumps
from hodge_pipeline.refine.path_size import path_size
from hodge_pipeline.refine.uncertainty import mean_chi2, pose_change
from hodge_pipeline.rounds.one_round import Work
from hodge_pipeline.rounds.settling import last_shift_m, settled_m
from hodge_pipeline.scene import KeyFrames, Round
from hodge_pipeline.sources.inspect import guesses
from hodge_pipeline.types import Floats, Ints, Source, Trajectory
from hodge_pipeline.types.notes import Note
from hodge_pipeline.types.text import counted, suiting

CHI2_TOLERANCE = 0.02
"""Share by which the mean χ² may grow: the solver minimises a robust cost, not this one."""
KNOTS_APART = (16, 8, 4, 2, 1)
"""Key frames between two knots of the correction: the steps between keep their given shape, which may be better than
registered ones. The widest spacing that fits the held-out pairs as well as the best is kept."""
KEPT = "nothing tells which are nearer: edges may err by as much as they correct these poses"
LEAST_JOINED = 0.2
"""Share of the key frames that must overlap with another one, else the given poses are not of these frames."""


@dataclass(frozen=True)
class Refined:
    """The decision of a refinement, poses (N, 4, 4) of all frames, and the `file` or folder of poses in the run folder.

    `file` is "" where nothing is written.
    """

    decision: Decision
    world_from_cam: Floats
    file: str


def finish(work: Work, folder: Path, rounds: Sequence[Round]) -> Refined:
    """Decide on the last round's poses and write `refined.<suffix>` into the run folder.

    Without an edge that relates the poses nothing is written but the report.
    """
    key_frames = work.scene.key_frames
    decision, after = _decision(work, rounds, key_frames)
    work.steps.note(Note("guard", detail=decision.reason))
    _tell_untested(work, decision, after)
    poses = key_frames.first if decision.keeps_input else key_frames.expand(after)
    file = None if decision.outcome == "nothing" else _write(work, folder, decision, after)
    return Refined(decision, poses, "" if file is None else file.name)


def _decision(work: Work, rounds: Sequence[Round], key_frames: KeyFrames) -> tuple[Decision, Floats]:
    """The decision, and the poses (K, 4, 4) of the key frames that it is about."""
    last, before = rounds[-1], key_frames.world_from_key
    convention = _convention(work, last, before)
    if convention and not work.recipe.guard.force:
        return Decision("convention", convention), before
    nothing = _nothing(last)
    if nothing or last.solution is None:
        return Decision("nothing", nothing), before
    jumps, mended, off_there = sure_jumps(work, key_frames, last.graph, last.solution)
    smoothed = without_noise(
        last.graph, last.solution, mended, first_of_steps(key_frames), work.recipe.guard.shared_errors
    )
    solved = last.world_from_cam if smoothed is None or smoothed is mended else smoothed
    chi2 = [mean_chi2(last.graph, last.solution.weights, poses) for poses in (before, solved)]
    found = spread_corrections(key_frames, solved, jumps)
    after, measures, held_out = _held_out(work, held_out_pairs(rounds), key_frames, found)
    measures.append(chi2_measure(*chi2))
    moved = pose_change(last.graph, replace(last.solution, world_from_cam=after), before)
    decision = decide(measures, moved, force=work.recipe.guard.force)
    if convention:
        return Decision("forced", convention, decision.measures, moved), after
    if len(jumps) and (decision.outcome == "optimal" or (decision.outcome == "refined" and smoothed is mended)):
        return _without_jumps(work, rounds, key_frames, mended, jumps, off_there)
    work.steps.note(held_out)
    if decision.outcome == "refined" and smoothed is mended:
        return Decision("optimal", KEPT, decision.measures, moved), after
    if decision.outcome == "refined":  # so far by clouds alone, which a sensor may warp alike in every frame
        measures += [
            *against_images(work, key_frames, after),
            *path_size(work, key_frames, after),
            *_settled(work, rounds),
        ]
        decision = decide(measures, moved, force=work.recipe.guard.force)
    return decision, after


def _without_jumps(
    work: Work, rounds: Sequence[Round], key_frames: KeyFrames, after: Floats, jumps: Ints, off_there: list[Measure]
) -> tuple[Decision, Floats]:
    """The decision on the given poses less their jumps (K, 4, 4), where nothing else of them is to be bettered."""
    last, before = rounds[-1], key_frames.world_from_key
    assert last.solution is not None
    after, measures, held_out = _held_out(work, held_out_pairs(rounds), key_frames, after[None])
    work.steps.note(held_out)
    chi2 = [mean_chi2(last.graph, last.solution.weights, poses) for poses in (before, after)]
    moved = pose_change(last.graph, replace(last.solution, world_from_cam=after), before)
    decision = decide([*off_there, *measures, chi2_measure(*chi2)], moved, force=work.recipe.guard.force)
    if decision.outcome == "refined":
        work.steps.note(jump_note(work, before, after, jumps))
    return decision, after


def _tell_untested(work: Work, decision: Decision, after: Floats) -> None:
    """Note the given poses that no frame tests, and by how much the nearest frame's correction moves them."""
    given = work.scene.given
    if given is None or given.has_frame.all():
        return
    without = ~given.has_frame
    count = int(without.sum())
    told = f"{counted(len(without), 'given pose')} {suiting(count, 'has|have')} no frame: not tested"
    if not decision.keeps_input and count < len(without):
        moved = given.expand(work.scene.key_frames, after) - given.trajectory.world_from_cam
        moved_m = np.linalg.norm(moved[:, :3, 3], axis=1)
        told += f", and moved as the nearest frame, by up to {length(moved_m[without].max())}"
        told += f", those with a frame by up to {length(moved_m[~without].max())}"
    work.steps.note(Note("mostly untested" if 2 * count > len(without) else "untested", count, told))


def _convention(work: Work, last: Round, before: Floats) -> str:
    """What is wrong with how the given poses were read, by the edges used; empty where nothing is known to be."""
    if last.solution is None:
        return ""
    used, graph = last.solution.weights > 0, last.graph
    found = explained(before, graph.edges[used], graph.i_from_j[used], se3.ARM_M * float(work.recipe.scale))
    if found.is_unlike and not found.wrong:
        work.steps.note(Note("given unlike", detail=f"{found.missed:.2f}"))
    return found.wrong


def _nothing(last: Round) -> str:
    """Why no measurement relates the poses; "" where one does."""
    if not last.graph.edge_count or last.solution is None:
        rejected = ", ".join(f"{count} {reason}" for reason, count in last.edges.rejected_counts.items())
        return f"no edge joins two frames ({rejected or 'no pair overlaps'}): nothing was refined"
    if not (last.solution.weights > 0).any():
        return f"the solver rejected every edge ({last.graph.edge_count}): nothing was refined"
    joined = len(np.unique(last.graph.edges))
    if joined < LEAST_JOINED * last.graph.vertex_count:
        found = f"{joined} of {last.graph.vertex_count} key frames overlap with another one"
        return f"under the given poses only {found}: are they the poses of these frames?"
    return ""


def spread_corrections(key_frames: KeyFrames, after: Floats, jumps: Ints) -> Floats:
    """Key-frame poses (S, K, 4, 4), one set for each spacing of `KNOTS_APART`: knots as solved, given steps between.

    Both ends of the given path's jumps, from the rows `jumps` to the next, are knots of each set.
    """
    out, count = [], len(after)
    for apart in KNOTS_APART:
        knots = np.unique(np.concatenate([np.arange(0, count, apart), [count - 1], jumps, jumps + 1]))
        some = replace(key_frames, rows=key_frames.rows[knots], world_from_key=key_frames.world_from_key[knots])
        out.append(after if apart == 1 else some.expand(after[knots])[key_frames.rows])
    return np.array(out)


def chi2_measure(before: float, after: float) -> Measure:
    """The mean χ² of the edges before and after, which may grow by `CHI2_TOLERANCE`."""
    return Measure("edge chi2, mean", before, after, tolerance=CHI2_TOLERANCE * before)


def _held_out(work: Work, pairs: Ints, key_frames: KeyFrames, found: Floats) -> tuple[Floats, list[Measure], Note]:
    """The first of the sets of poses (S, K, 4, 4) that fits the pairs held out of every round as well as the best,
    their score as a measure, and a note. Without such pairs the last set, and no measure.
    """
    if not len(pairs):
        return found[-1], [], Note("nothing held out", 0)
    scale = float(work.recipe.scale)
    poses = np.stack([key_frames.world_from_key, *found])
    distances = apart_m(work, pairs, poses, "guard")
    scores = np.exp(-distances / (scale * SIGMA_M))
    row = 1 + first_as_good(scores[1:])
    scores, distances = scores[[0, row]], distances[[0, row]]
    tolerance = max(mean_noise(scores[1] - scores[0]), SCORE_TOLERANCE)
    mean_mm, mean = distances.mean(axis=1) * 1000, scores.mean(axis=1)
    apart = f"{mean_mm[0]:.3g} mm apart before, {mean_mm[1]:.3g} mm after"
    knots = f", the correction at every {KNOTS_APART[row - 1]}. key frame" if len(found) > 1 else ""
    told, name = Note("held out", len(pairs), apart + knots), "score of held-out edges"
    measure = Measure(name, float(mean[0]), float(mean[1]), "higher", tolerance, is_held_out=True)
    return found[row - 1], [measure], told


def _settled(work: Work, rounds: Sequence[Round]) -> list[Measure]:
    """How far the last round may move the poses, and moved them; empty where they have settled."""
    last = rounds[-1]
    component = connected_components(last.graph.edges, last.graph.vertex_count)
    limit_m = settled_m(last.world_from_cam[:, :3, 3], float(work.recipe.scale))
    shift_m = last_shift_m(rounds, component)
    if shift_m is None or shift_m <= limit_m:
        return []
    return [Measure("movement that the last round may make, and made", limit_m, shift_m, unit="m")]


def first_as_good(scores: Floats) -> int:
    """The first row of scores (S, P) whose mean is within one standard error of the best row's."""
    losses = scores[scores.mean(axis=1).argmax()] - scores
    noise = np.maximum(losses.std(axis=1) / np.sqrt(scores.shape[1]), SCORE_TOLERANCE)
    return int(np.flatnonzero(losses.mean(axis=1) <= noise)[0])


def _write(work: Work, folder: Path, decision: Decision, after: Floats) -> Path | None:
    """Write `refined.<suffix>`: the input's own bytes where it is kept, else the refined poses in its format.

    A format without a rewriter becomes `refined.tum`, with a note. None where the poses came from no file.
    """
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
    moved = given.expand(work.scene.key_frames, after)
    refined = Trajectory(given.trajectory.stamps_s, moved)
    if rewriter is not None:
        return Path(rewriter.rewrite(folder, original, refined))
    work.steps.note(Note("other format", detail=original.suffix or "a folder"))
    registry.load("writers", "tum")().write(folder / "refined.tum", Source("refined", original, trajectory=refined))
    return folder / "refined.tum"
