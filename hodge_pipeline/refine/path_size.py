"""Whether refinement changed the size of the path, and jumps of the given path that look like it."""

from __future__ import annotations

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.evaluation.difference import length
from hodge_pipeline.evaluation.trajectory import absolute_error
from hodge_pipeline.refine.against_images import STEP_TOLERANCE_MM, first_of_steps, off_images_m
from hodge_pipeline.refine.guard import Measure
from hodge_pipeline.rounds.one_round import Work
from hodge_pipeline.scene import KeyFrames, vertex_ids
from hodge_pipeline.types import Floats, Ints
from hodge_pipeline.types.notes import Note

TOLD_SIZE, LARGEST_SIZE = 0.005, 0.1
"""Share by which a path may grow or shrink before it is reported, and before the result is refused: focal lengths are
known to a few per cent."""
SIZE_LEAVES = 0.5
"""Share of the movement left after scaling, up to which scale explains it: drift bends a path instead."""
UNLIKE, MOST_JUMPS = 0.5, 3
"""A step that differs from the refined one by more than half of the longer of the two is no scaled copy of it; jumps
that a note names.
"""


def path_size(work: Work, key_frames: KeyFrames, after: Floats) -> list[Measure]:
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
