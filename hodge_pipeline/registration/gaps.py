"""Holes in a recording: no motion over one can be guessed, and what little two frames share may be another place."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from hodge_pipeline.scene import is_clock
from hodge_pipeline.types import Bools, Floats, Ints
from hodge_pipeline.types.notes import Note

LONGEST_USUAL = 10.0
"""Times the median step of a sequence; cameras that drop some frames, or keep some of them, stay below it."""
NO_HOLE_S = 0.2
"""The step of a video of 5 frames a second, over which tracking holds."""
GAPS_TOLD = 5
"""Holes that a note names, which then fits a line."""


def longest_usual_step_s(stamps_s: Floats) -> float:
    """What a step of a sequence with these stamps (N,) may last, a slow video's in any case; ∞ where they do not
    ascend, and so are no clock.
    """
    steps = np.diff(stamps_s)
    if len(steps) < 2 or not (steps > 0).all():
        return float("inf")
    return max(LONGEST_USUAL * float(np.median(steps)), NO_HOLE_S)


def over_gap(pairs: Ints, sequences: Sequence[Ints], stamps_s: Floats) -> Bools:
    """Where (P,) rows of one sequence lie on the two sides of a hole in it."""
    longest = np.full(len(stamps_s), np.inf)
    for rows in sequences:
        longest[rows] = longest_usual_step_s(stamps_s[rows])
    return np.asarray(stamps_s[pairs[:, 1]] - stamps_s[pairs[:, 0]] > longest[pairs[:, 0]])


def told_gaps(sequences: Sequence[Ints], stamps_s: Floats, ids: NDArray[np.generic]) -> tuple[Note, ...]:
    """A note of the holes in the sequences of frames with these ids (N,), the first ones by the frame behind them: how
    long they last by a clock, or how many frames they leave out where stamps are numbers of frames.
    """
    holes = gaps(sequences, stamps_s)
    if not len(holes):
        return ()
    steps = stamps_s[holes[:, 1]] - stamps_s[holes[:, 0]]
    if is_clock(stamps_s[np.concatenate(sequences)]):
        lengths = [f"{step_s:.1f} s" for step_s in steps.tolist()]
    else:
        usual = float(np.median(np.concatenate([np.diff(stamps_s[rows]) for rows in sequences])))
        lengths = [f"{step / usual - 1:.0f} frames" for step in steps.tolist()]
    told = [f"{length} before {ids[j]}" for length, j in zip(lengths, holes[:, 1].tolist(), strict=True)]
    return (Note("holes", len(holes), ", ".join(told[:GAPS_TOLD]) + ", …" * (len(holes) > GAPS_TOLD)),)


def gaps(sequences: Sequence[Ints], stamps_s: Floats) -> Ints:
    """The rows (G, 2) before and behind each hole."""
    steps = np.concatenate([np.zeros((0, 2), np.int64), *(np.stack([r[:-1], r[1:]], axis=1) for r in sequences)])
    return np.asarray(steps[over_gap(steps, sequences, stamps_s)])
