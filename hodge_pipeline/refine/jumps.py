"""Jumps of the given path: steps that neither the refined path nor images have, as of a tracker that relocalised."""

from __future__ import annotations

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.evaluation.difference import length
from hodge_pipeline.refine.against_images import MOST_STEPS, first_of_steps, off_images_m
from hodge_pipeline.refine.guard import Measure
from hodge_pipeline.rounds.one_round import Work
from hodge_pipeline.scene import KeyFrames, vertex_ids
from hodge_pipeline.types import Floats, Ints
from hodge_pipeline.types.arrays import evenly
from hodge_pipeline.types.notes import Note

UNLIKE, MOST_JUMPS = 0.5, 3
"""A step that differs from the refined one by more than half of the longer of the two is no scaled copy of it; jumps
that a note names.
"""
FAR, NEARER = 12.0, 4.0
"""Times the usual (median) step's error by images from which a given step is surely a jump, and times as near as it
that the refined step must be. True steps over one frame to ten are up to 10 times as far off as the median in fr1/rpy,
9 in red kitchen, 3 in fr1/xyz; a pose 30 cm off is 126 times.
"""


def sure_jumps(work: Work, key_frames: KeyFrames, after: Floats) -> tuple[Ints, Floats, list[Measure]]:
    """The rows of key frames from which the given path jumps to the next, by far more than images err; the given poses
    (K, 4, 4) without these jumps; and how far the steps there lie from images, before and after. None without images.

    Pairs that are held out seldom touch a pose that is far off, since there it overlaps with nothing.
    """
    before = key_frames.world_from_key
    rows, _ = jumps_of(work, key_frames, after)
    if not len(rows):
        return rows, before, []
    firsts = first_of_steps(key_frames)
    firsts = firsts[evenly(len(firsts), MOST_STEPS)]
    usual, off = (off_images_m(work, some, before, after) for some in (firsts, rows))
    if not np.isfinite(usual).all(axis=0).any():
        return rows[:0], before, []
    usual_m = float(np.nanmedian(usual[1]))
    sure = (off[0] > FAR * usual_m) & (NEARER * off[1] < off[0])  # which NaN is not
    if not sure.any():
        return rows[:0], before, []
    before_mm, after_mm = 1000 * off[:, sure].mean(axis=1)
    name, tolerance_mm = "steps at jumps off those of images", 1000 * usual_m
    measure = Measure(name, float(before_mm), float(after_mm), tolerance=tolerance_mm, unit="mm", is_held_out=True)
    arm_m = se3.ARM_M * float(work.recipe.scale)
    return rows[sure], without_steps(before, after, rows[sure], FAR * usual_m, arm_m), [measure]


def jump_note(work: Work, before: Floats, after: Floats, jumps: Ints) -> Note:
    """A note that names the jumps, and how long they are before and after."""
    names = vertex_ids(work.scene.source)
    lengths_m = [np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1) for poses in (before, after)]
    steps = [
        f"from frame {names[k]} to {names[k + 1]} by {', not '.join(length(m[k]) for m in lengths_m)}" for k in jumps
    ]
    more = f"; and {len(steps) - MOST_JUMPS} more" if len(steps) > MOST_JUMPS else ""
    return Note("given jumps", len(jumps), "; ".join(steps[:MOST_JUMPS]) + more)


def without_steps(before: Floats, after: Floats, jumps: Ints, near_m: float = 0.0, arm_m: float = se3.ARM_M) -> Floats:
    """The poses (K, 4, 4) before, their steps from the rows `jumps` taken from those after.

    Where the next jump leads back, so that the motion over both is within `near_m` of the one after, at this arm, only
    the poses between them move: errors of two steps would put all others off.
    """
    out, left = before.copy(), np.sort(jumps).tolist()
    while left:
        k, end = left.pop(0), len(out)
        if left:
            over = [se3.inverse(poses[k]) @ poses[left[0] + 1] for poses in (before, after)]
            if se3.displacement_m(se3.inverse(over[0]) @ over[1], arm_m) < near_m:
                end = left.pop(0) + 1
        step = se3.inverse(after[k]) @ after[k + 1]
        out[k + 1 : end] = out[k] @ step @ se3.inverse(out[k + 1]) @ out[k + 1 : end]
    return out


def jumps_of(work: Work, key_frames: KeyFrames, after: Floats) -> tuple[Ints, int]:
    """The rows of key frames from which the given path jumps to the next, the farthest first: steps unlike the refined
    ones, times the factor of the others, and farther than those from what images show; without images, longer ones.
    And how many of them are more than half as far as the first.

    None where these are not a minority of the path: then it is another path.
    """
    firsts = first_of_steps(key_frames)
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
    off_m = off_images_m(work, rows, key_frames.world_from_key, after)
    known = np.isfinite(off_m).all(axis=0)
    jumped = np.where(known, off_m[1] < off_m[0], factor * lengths[0, unlike] > lengths[1, unlike])
    rows, off = rows[jumped], off[jumped]
    return rows[np.argsort(-off)], max(int((off > UNLIKE * off.max(initial=0)).sum()), 1)


def _weighted_median(values: Floats, weights: Floats) -> float:
    order = np.argsort(values)
    share = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(share, share[-1] / 2)])
