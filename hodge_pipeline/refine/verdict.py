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
from hodge_pipeline.evaluation.scores import SIGMA_M, edge_distances
from hodge_pipeline.evaluation.trajectory import absolute_error
from hodge_pipeline.pairs.held_out import held_out_pairs
from hodge_pipeline.refine.conventions import explained
from hodge_pipeline.refine.guard import SCORE_TOLERANCE, Decision, Measure, decide
from hodge_pipeline.refine.image_steps import MOST_STEPS, step_errors
from hodge_pipeline.refine.uncertainty import mean_chi2, pose_change
from hodge_pipeline.rounds.one_round import Work
from hodge_pipeline.rounds.settling import last_shift_m, settled_m
from hodge_pipeline.scene import KeyFrames, Round, vertex_ids
from hodge_pipeline.sources.inspect import guesses
from hodge_pipeline.stages import Step, Workers
from hodge_pipeline.types import CloudSet, Floats, Ints, Source, Trajectory
from hodge_pipeline.types.arrays import evenly
from hodge_pipeline.types.notes import Note
from hodge_pipeline.types.text import counted, suiting

CHI2_TOLERANCE = 0.02
"""Share by which the mean χ² may grow: the solver minimises a robust cost, not this one."""
NOISE_SIGMAS = 3.0
"""Standard errors of a mean difference that count as its noise."""
KNOTS_APART = (16, 8, 4, 2, 1)
"""Key frames between two knots of the correction: the steps between keep their given shape, which may be better than
registered ones. The widest spacing that fits the held-out pairs as well as the best is kept."""
STEP_TOLERANCE, STEP_TOLERANCE_MM = 1.0, 5.0
"""Share, and millimetres in a room, by which steps may get farther from those of images. Registered steps may be
rougher than a visual odometry's and yet drift less; steps twice as far off belong to other poses."""
ROUGHER = 0.1
"""Share from which on rougher steps are reported."""
FEWEST_STEPS = 6
"""Steps that images measure: fewer are not judged."""
TOLD_SIZE, LARGEST_SIZE = 0.005, 0.1
"""Share by which a path may grow or shrink before it is reported, and before the result is refused: focal lengths are
known to a few per cent."""
SIZE_LEAVES = 0.5
"""Share of the movement left after scaling, up to which scale explains it: drift bends a path instead."""
UNLIKE, MOST_JUMPS = 0.5, 3
"""A step that differs from the refined one by more than half of the longer of the two is no scaled copy of it; jumps
that a note names.
"""
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
    chi2 = [mean_chi2(last.graph, last.solution.weights, poses) for poses in (before, last.world_from_cam)]
    after, measures = _held_out(work, rounds, key_frames)
    measures.append(chi2_measure(*chi2))
    moved = pose_change(last.graph, replace(last.solution, world_from_cam=after), before)
    decision = decide(measures, moved, force=work.recipe.guard.force)
    if convention:
        return Decision("forced", convention, decision.measures, moved), after
    if decision.outcome == "refined":  # so far by clouds alone, which a sensor may warp alike in every frame
        measures += [*_images(work, key_frames, after), *_size(work, key_frames, after), *_settled(work, rounds)]
        decision = decide(measures, moved, force=work.recipe.guard.force)
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


def spread_corrections(key_frames: KeyFrames, after: Floats) -> Floats:
    """Key-frame poses (S, K, 4, 4), one set for each spacing of `KNOTS_APART`: knots as solved, given steps between."""
    out, count = [], len(after)
    for apart in KNOTS_APART:
        knots = np.union1d(np.arange(0, count, apart), count - 1)
        some = replace(key_frames, rows=key_frames.rows[knots], world_from_key=key_frames.world_from_key[knots])
        out.append(after if apart == 1 else some.expand(after[knots])[key_frames.rows])
    return np.array(out)


def chi2_measure(before: float, after: float) -> Measure:
    """The mean χ² of the edges before and after, which may grow by `CHI2_TOLERANCE`."""
    return Measure("edge chi2, mean", before, after, tolerance=CHI2_TOLERANCE * before)


def _held_out(work: Work, rounds: Sequence[Round], key_frames: KeyFrames) -> tuple[Floats, list[Measure]]:
    """The widest spaced correction (K, 4, 4) that fits the pairs held out of every round, and their score as a measure.

    Without such pairs the last round's poses, and no measure.
    """
    pairs, after = held_out_pairs(rounds), rounds[-1].world_from_cam
    if not len(pairs):
        work.steps.note(Note("nothing held out", 0))
        return after, []
    found = spread_corrections(key_frames, after)
    scale = float(work.recipe.scale)
    poses = np.stack([key_frames.world_from_key, *found])
    distances = work.steps.step(
        held_out_distances_m, work.scene.clouds, pairs, poses, scale, title="guard", workers=work.workers
    )
    scores = np.exp(-distances / (scale * SIGMA_M))
    row = 1 + first_as_good(scores[1:])
    scores, distances = scores[[0, row]], distances[[0, row]]
    error = float((scores[1] - scores[0]).std() / np.sqrt(len(pairs)))
    tolerance = max(NOISE_SIGMAS * error, SCORE_TOLERANCE)
    mean_mm, mean = distances.mean(axis=1) * 1000, scores.mean(axis=1)
    apart = f"{mean_mm[0]:.3g} mm apart before, {mean_mm[1]:.3g} mm after"
    work.steps.note(Note("held out", len(pairs), f"{apart}, the correction at every {KNOTS_APART[row - 1]}. key frame"))
    name = "score of held-out edges"
    return found[row - 1], [Measure(name, float(mean[0]), float(mean[1]), "higher", tolerance, is_held_out=True)]


def _firsts(key_frames: KeyFrames) -> Ints:
    """The rows, among the key frames, of those that another one of their sequence follows."""
    sequence = key_frames.sequence[key_frames.rows]
    return np.flatnonzero(sequence[1:] == sequence[:-1])


def _off_images_m(work: Work, firsts: Ints, before: Floats, after: Floats) -> Floats:
    """How far (2, S) the steps from these key frames to the next, before and after, lie from those that images show;
    NaN where there are none.
    """
    source, scale = work.scene.source, float(work.recipe.scale)
    if not len(firsts) or not all(frame.read_colour and frame.read_depth for frame in source.frames):
        return np.full((2, len(firsts)), np.nan)
    pairs, poses = np.column_stack([firsts, firsts + 1]), np.stack([before, after])
    found = work.steps.step(step_errors, source, pairs, poses, scale, title="guard: images", total=len(pairs))
    return found.off_m


def _images(work: Work, key_frames: KeyFrames, after: Floats) -> list[Measure]:
    """How far steps from key frame to key frame lie from those of optical flow; empty without images or depth."""
    firsts, scale = _firsts(key_frames), float(work.recipe.scale)
    firsts = firsts[evenly(len(firsts), MOST_STEPS)]
    off_m = _off_images_m(work, firsts, key_frames.world_from_key, after)
    before_mm, after_mm = off_m[:, np.isfinite(off_m).all(axis=0)] * 1000
    if len(before_mm) < FEWEST_STEPS:
        return []
    error_mm = float((after_mm - before_mm).std() / np.sqrt(len(before_mm)))
    mean = float(before_mm.mean()), float(after_mm.mean())
    if mean[1] > (1 + ROUGHER) * mean[0] + error_mm:
        work.steps.note(Note("rougher", detail=f"{mean[1]:.3g} mm off, before {mean[0]:.3g} mm"))
    tolerance_mm = max(NOISE_SIGMAS * error_mm, STEP_TOLERANCE * mean[0], STEP_TOLERANCE_MM * scale)
    return [Measure("steps off those of images", *mean, tolerance=tolerance_mm, unit="mm")]


def _size(work: Work, key_frames: KeyFrames, after: Floats) -> list[Measure]:
    """By what share the path (K, 4, 4) became larger or smaller; empty where poses moved mostly in other ways, or a few
    jumps of the given path hold the difference, which are told.
    """
    before = key_frames.world_from_key
    measures, told = _size_change(work, before, after)
    jumps, few = _jumps(work, key_frames, after) if measures else (key_frames.rows[:0], 1)
    for count in range(few, len(jumps) + 1):
        mended = _size_change(work, _without_steps(before, after, jumps[:count]), after)
        if not any(measure.is_worse for measure in mended[0]):
            measures, told = mended[0], [_jump_note(work, before, after, jumps[:count]), *mended[1]]
            break
    work.steps.note(*told)
    return measures


def _jump_note(work: Work, before: Floats, after: Floats, jumps: Ints) -> Note:
    names = vertex_ids(work.scene.source)
    lengths_m = [np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1) for poses in (before, after)]
    steps = [
        f"from frame {names[k]} to {names[k + 1]} by {', not '.join(length(m[k]) for m in lengths_m)}" for k in jumps
    ]
    more = f"; and {len(steps) - MOST_JUMPS} more" if len(steps) > MOST_JUMPS else ""
    return Note("given jumps", len(jumps), "; ".join(steps[:MOST_JUMPS]) + more)


def _without_steps(before: Floats, after: Floats, jumps: Ints) -> Floats:
    """The poses (K, 4, 4) before, their steps from the rows `jumps` taken from those after."""
    out = before.copy()
    for k in jumps.tolist():
        out[k + 1 :] = out[k] @ se3.inverse(after[k]) @ after[k + 1] @ se3.inverse(out[k + 1]) @ out[k + 1 :]
    return out


def _jumps(work: Work, key_frames: KeyFrames, after: Floats) -> tuple[Ints, int]:
    """The rows of key frames from which the given path jumps to the next, the farthest first: steps unlike the refined
    ones, times the factor of the others, and farther than those from what images show; without images, longer ones.
    And how many of them are more than half as far as the first.

    None where these are not a minority of the path: then it is another path.
    """
    firsts = _firsts(key_frames)
    steps = [(se3.inverse(poses[firsts]) @ poses[firsts + 1])[:, :3, 3] for poses in (key_frames.world_from_key, after)]
    lengths = np.linalg.norm(steps, axis=-1)
    common = lengths.min(axis=0)  # of a jump, and of standing still, next to nothing
    if not common.sum() > 0:
        return firsts[:0], 1
    factor = _weighted_median(lengths[1] / np.maximum(lengths[0], np.finfo(float).tiny), common)
    off = np.linalg.norm(steps[1] - factor * steps[0], axis=1)
    unlike = off > UNLIKE * np.maximum(factor * lengths[0], lengths[1])
    if common[unlike].sum() > UNLIKE * common.sum():
        return firsts[:0], 1
    rows, off = firsts[unlike], off[unlike]
    off_m = _off_images_m(work, rows, key_frames.world_from_key, after)
    known = np.isfinite(off_m).all(axis=0)
    jumped = np.where(known, off_m[1] < off_m[0], factor * lengths[0, unlike] > lengths[1, unlike])
    rows, off = rows[jumped], off[jumped]
    return rows[np.argsort(-off)], max(int((off > UNLIKE * off.max(initial=0)).sum()), 1)


def _weighted_median(values: Floats, weights: Floats) -> float:
    order = np.argsort(values)
    share = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(share, share[-1] / 2)])


def _size_change(work: Work, before: Floats, after: Floats) -> tuple[list[Measure], list[Note]]:
    """By what share a path (K, 4, 4) became larger or smaller, and a note; empty where poses moved in other ways."""
    if len(before) < 3:
        return [], []
    spreads = [float(np.linalg.norm(poses[:, :3, 3] - poses[:, :3, 3].mean(axis=0))) for poses in (before, after)]
    left = [absolute_error(before, after, with_scale=scaled).rmse_m for scaled in (False, True)]
    factor = spreads[1] / spreads[0] if spreads[0] > 0 else 1.0
    moved = left[0] * 1000 > STEP_TOLERANCE_MM * float(work.recipe.scale)
    if not (moved and abs(factor - 1) > TOLD_SIZE and left[1] <= SIZE_LEAVES * left[0]):
        return [], []
    told = Note("path scaled", detail=f"{factor:.3g}")
    return [Measure("change of the path's size", 0.0, abs(factor - 1), tolerance=LARGEST_SIZE)], [told]


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


def held_out_distances_m(
    clouds: CloudSet, pairs: Ints, pose_sets: Floats, scale: float, *, workers: Workers, step: Step
) -> Floats:
    """Step: cloud distances (S, P) of the pairs (P, 2) under S sets of poses (S, K, 4, 4), metres."""
    assert clouds.folder is not None
    return edge_distances(clouds.folder, pairs, pose_sets, workers, scale=scale)


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
