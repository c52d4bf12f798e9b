"""Jumps of the given path: steps that neither the refined path nor images or clouds have, as of a lost tracker."""

from __future__ import annotations

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.evaluation.difference import length
from hodge_pipeline.evaluation.scores import edge_distances
from hodge_pipeline.refine.against_images import first_of_steps, off_images, step_difference
from hodge_pipeline.refine.given_noise import far_steps
from hodge_pipeline.refine.guard import Measure
from hodge_pipeline.rounds.one_round import Work
from hodge_pipeline.scene import KeyFrames, vertex_ids
from hodge_pipeline.stages import Step, Workers
from hodge_pipeline.types import CloudSet, Floats, Ints, Solution, ViewGraph
from hodge_pipeline.types.notes import Note

UNLIKE, MOST_JUMPS = 0.5, 3
"""A step that differs from the refined one by more than half of the longer of the two is no scaled copy of it, and a
path of which more than half does is another one; jumps that a note names.
"""
LED_BACK = 0.25
"""Share of what each of two jumps puts a step off, up to which the second takes the first back: of the least jump, 8
standard errors of a step (`JUMP`), that is 2.
"""


def sure_jumps(
    work: Work, key_frames: KeyFrames, graph: ViewGraph, solution: Solution
) -> tuple[Ints, Floats, list[Measure]]:
    """The rows of key frames from which the given path jumps to the next, by far more than edges err, see `far_steps`;
    the given poses (K, 4, 4) without these jumps; and how far images, or else clouds, lie off there, before and after.

    None where these are not a minority of the steps: then it is another path. Pairs that are held out seldom touch a
    pose that is far off, since there it overlaps with nothing.
    """
    before, after = key_frames.world_from_key, solution.world_from_cam
    firsts = first_of_steps(key_frames)
    rows = far_steps(graph, solution, before, firsts, work.recipe.guard.shared_errors)
    if len(rows) > UNLIKE * len(firsts):
        return rows[:0], before, []
    off_m = _off_m(work, rows, before, after)
    nearer = off_m[1] < off_m[0]
    if not nearer.any():
        return rows[:0], before, []
    rows, (before_mm, after_mm) = rows[nearer], 1000 * off_m[:, nearer].mean(axis=1)
    name = "steps at jumps off images or clouds"
    measure = Measure(name, float(before_mm), float(after_mm), unit="mm", is_held_out=True)
    return rows, without_steps(before, after, rows, se3.ARM_M * float(work.recipe.scale)), [measure]


def jump_note(work: Work, before: Floats, after: Floats, jumps: Ints) -> Note:
    """A note that names the jumps, and how long they are before and after, or by what turn they differ."""
    names = vertex_ids(work.scene.source)
    arm_m = se3.ARM_M * float(work.recipe.scale)
    told = [_told(before[k : k + 2], after[k : k + 2], arm_m) for k in jumps]
    steps = [f"from frame {names[k]} to {names[k + 1]} by {how}" for k, how in zip(jumps, told, strict=True)]
    more = f"; and {len(steps) - MOST_JUMPS} more" if len(steps) > MOST_JUMPS else ""
    return Note("given jumps", len(jumps), "; ".join(steps[:MOST_JUMPS]) + more)


def _told(before: Floats, after: Floats, arm_m: float) -> str:
    """How long the step between two poses (2, 4, 4) is, before and after, or by what turn they differ, where this moves
    more at the end of an arm.
    """
    steps = [se3.inverse(poses[0]) @ poses[1] for poses in (before, after)]
    shift_m, turn = step_difference(*steps)
    if shift_m < arm_m * turn:
        return f"a turn of {np.degrees(turn):.3g}°"
    return ", not ".join(length(float(np.linalg.norm(step[:3, 3]))) for step in steps)


def without_steps(before: Floats, after: Floats, jumps: Ints, arm_m: float = se3.ARM_M) -> Floats:
    """The poses (K, 4, 4) before, their steps from the rows `jumps` taken from those after.

    Where the next jump leads back, so that the motion over both differs from the one after by `LED_BACK` of what the
    two steps do, only the poses between them move: errors of two steps would put all others off. What follows a jump
    moves as one, or each pose about itself, as where a camera was knocked on its mount: whichever leaves its steps more
    like those after.
    """
    out, left = before.copy(), np.sort(jumps).tolist()

    def off_m(start: int, end: int) -> float:
        start_from_ends = [se3.inverse(poses[start]) @ poses[end] for poses in (before, after)]
        return float(se3.displacement_m(se3.inverse(start_from_ends[0]) @ start_from_ends[1], arm_m))

    while left:
        k, end = left.pop(0), len(out)
        until = left[0] + 1 if left else end
        if left and off_m(k, until) < LED_BACK * min(off_m(k, k + 1), off_m(left[0], until)):
            left.pop(0)
            end = until
        moved = _rigid(out[k] @ se3.inverse(after[k]) @ after[k + 1] @ se3.inverse(out[k + 1]))
        ways = [moved @ out[k + 1 : end], out[k + 1 : end] @ _rigid(se3.inverse(out[k + 1]) @ moved @ out[k + 1])]
        unlike_m = [_unlike_m(poses[: until - k - 1], after[k + 1 : until], arm_m) for poses in ways]
        out[k + 1 : end] = ways[int(np.argmin(unlike_m))]
    return out


def _rigid(motion: Floats) -> Floats:
    """The motion (4, 4) without what rounding adds to its rotation: each jump would double that of the one before."""
    return se3.from_parts(se3.project_to_so3(motion[:3, :3]), motion[:3, 3])


def _unlike_m(poses: Floats, after: Floats, arm_m: float) -> float:
    """How far the steps of poses (K, 4, 4) lie from those after, at this arm: the median, 0 without a step."""
    one, other = (se3.inverse(some[:-1]) @ some[1:] for some in (poses, after))
    return float(np.median(se3.displacement_m(se3.inverse(one) @ other, arm_m))) if len(one) else 0.0


def jumps_of(work: Work, key_frames: KeyFrames, after: Floats) -> tuple[Ints, int]:
    """The rows of key frames from which the given path jumps to the next, the farthest first: steps unlike the refined
    ones, times the factor of the others, and farther than those from what images show; without images, such that the
    clouds lie nearer to each other at the refined ones. And how many of them are more than half as far as the first.

    None where these are not a minority of the path: then it is another path.
    """
    firsts, before = first_of_steps(key_frames), key_frames.world_from_key
    steps = [(se3.inverse(poses[firsts]) @ poses[firsts + 1])[:, :3, 3] for poses in (before, after)]
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
    off_m = _off_m(work, rows, before, after)
    jumped = off_m[1] < off_m[0]
    rows, off = rows[jumped], off[jumped]
    return rows[np.argsort(-off)], max(int((off > UNLIKE * off.max(initial=0)).sum()), 1)


def _off_m(work: Work, firsts: Ints, before: Floats, after: Floats) -> Floats:
    """How far (2, S) the steps from these key frames to the next, before and after, lie from those that images show, as
    displacements; where these show none, how far the two clouds lie from each other.
    """
    off_m = off_images(work, firsts, before, after) @ [1, se3.ARM_M * float(work.recipe.scale)]
    unseen = firsts[np.isnan(off_m).any(axis=0)]
    if len(unseen):
        pairs, poses = np.column_stack([unseen, unseen + 1]), np.stack([before, after])
        off_m[:, np.isin(firsts, unseen)] = apart_m(work, pairs, poses, "guard: clouds")
    return np.asarray(off_m)


def apart_m(work: Work, pairs: Ints, pose_sets: Floats, title: str) -> Floats:
    """How far (S, P) the clouds of pairs (P, 2) of key frames lie from each other under sets of poses (S, K, 4, 4)."""
    scale = float(work.recipe.scale)
    return work.steps.step(distances_m, work.scene.clouds, pairs, pose_sets, scale, title=title, workers=work.workers)


def distances_m(
    clouds: CloudSet, pairs: Ints, pose_sets: Floats, scale: float, *, workers: Workers, step: Step
) -> Floats:
    """Step: cloud distances (S, P) of the pairs (P, 2) under S sets of poses (S, K, 4, 4), metres."""
    return edge_distances(clouds.folder, pairs, pose_sets, workers, scale=scale)


def _weighted_median(values: Floats, weights: Floats) -> float:
    order = np.argsort(values)
    share = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(share, share[-1] / 2)])
