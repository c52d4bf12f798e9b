"""Whether refinement changed the size of the path, jumps of the given one aside."""

from __future__ import annotations

import numpy as np

from hodge_pipeline.evaluation.trajectory import absolute_error
from hodge_pipeline.refine.against_images import STEP_TOLERANCE_MM
from hodge_pipeline.refine.guard import Measure
from hodge_pipeline.refine.jumps import jump_note, jumps_of, without_steps
from hodge_pipeline.rounds.one_round import Work
from hodge_pipeline.scene import KeyFrames
from hodge_pipeline.types import Floats
from hodge_pipeline.types.notes import Note

TOLD_SIZE, LARGEST_SIZE = 0.005, 0.1
"""Share by which a path may grow or shrink before it is reported, and before the result is refused: focal lengths are
known to a few per cent."""
SIZE_LEAVES = 0.5
"""Share of the movement left after scaling, up to which scale explains it: drift bends a path instead."""


def path_size(work: Work, key_frames: KeyFrames, after: Floats) -> list[Measure]:
    """By what share the path (K, 4, 4) became larger or smaller; empty where poses moved mostly in other ways, or a few
    jumps of the given path hold the difference, which are told.
    """
    before = key_frames.world_from_key
    measures, told = _size_change(work, before, after)
    jumps, few = jumps_of(work, key_frames, after) if measures else (key_frames.rows[:0], 1)
    for count in range(few, len(jumps) + 1):
        mended = _size_change(work, without_steps(before, after, jumps[:count]), after)
        if not any(measure.is_worse for measure in mended[0]):
            measures, told = mended[0], [jump_note(work, before, after, jumps[:count]), *mended[1]]
            break
    work.steps.note(*told)
    return measures


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
