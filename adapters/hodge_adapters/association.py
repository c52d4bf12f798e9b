"""Which image belongs to which, by nearest stamp, and where a clock jumps back."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hodge_pipeline.types import Bools, Floats, Ints
from hodge_pipeline.types.notes import Note

NEIGHBOURS = 4
"""How many stamps on each side are looked at; more would only matter where stamps crowd within the tolerance."""
JUMP, FEWEST_OF_RUN = 10.0, 10
"""Usual steps by which a clock jumps back, and stamps to a jump: more of either are stamps out of order."""

MISSING = 0.1
"""The share of the images from which it is a doubt that they are missing: a sequence loses single ones."""
UNPAIRED = 0.6
"""The share of depth images without colour from which it is a doubt: colour at half the rate leaves half, and a few."""


def unpaired_doubts(paired: Sequence[bool]) -> tuple[Note, ...]:
    """A doubt where most depth images have no colour image although there are some: `paired` of each depth image."""
    without = len(paired) - sum(paired)
    return (Note("colour unpaired", without, str(len(paired))),) if without > UNPAIRED * len(paired) else ()


def clock_runs(stamps_s: Floats, follows: Bools | None = None) -> Ints:
    """The run (N,) of each stamp as written, ascending: a new one begins where the clock jumps back.

    One run of all where they are shuffled. Only stamps that `follows (N - 1,)` says were written after the one before
    tell of a jump.
    """
    steps = np.diff(stamps_s)
    ahead = steps[steps > 0]
    jumps = steps < -JUMP * np.median(ahead) if len(ahead) else np.zeros(len(steps), bool)
    back = np.flatnonzero(jumps if follows is None else jumps & follows)
    if len(back) * FEWEST_OF_RUN > len(stamps_s):
        back = back[:0]
    return np.asarray(np.searchsorted(back, np.arange(len(stamps_s)), side="left"), np.int64)


def nearest_in_runs(
    depth_stamps_s: Floats, depth_runs: Ints, colour_stamps_s: Floats, colour_runs: Ints, max_difference_s: float
) -> Ints:
    """As `nearest_pairs`, among the stamps of one run of the clock each; colour stamps ascend in each run."""
    columns = np.full(len(depth_stamps_s), -1, np.int64)
    for run in np.unique(depth_runs):
        own, other = np.flatnonzero(depth_runs == run), np.flatnonzero(colour_runs == run)
        found = nearest_pairs(depth_stamps_s[own], colour_stamps_s[other], max_difference_s)
        columns[own] = np.where(found >= 0, np.append(other, -1)[found], -1)
    return columns


def nearest_pairs(depth_stamps_s: Floats, colour_stamps_s: Floats, max_difference_s: float) -> Ints:
    """For each depth stamp the row of its colour stamp, -1 where there is none (N,).

    Pairs are made in the order of their difference, each stamp is used at most once (as the TUM benchmark's own tool
    does). Colour stamps ascend.
    """
    colour_of = np.full(len(depth_stamps_s), -1, np.int64)
    if not len(colour_stamps_s):
        return colour_of
    offsets = np.arange(-NEIGHBOURS, NEIGHBOURS)
    columns = np.searchsorted(colour_stamps_s, depth_stamps_s)[:, None] + offsets
    inside = (columns >= 0) & (columns < len(colour_stamps_s))
    columns = np.clip(columns, 0, len(colour_stamps_s) - 1)
    difference = np.abs(colour_stamps_s[columns] - depth_stamps_s[:, None])
    rows, slots = np.nonzero(inside & (difference <= max_difference_s))
    used = np.zeros(len(colour_stamps_s), bool)
    for at in np.argsort(difference[rows, slots], kind="stable"):
        row, column = rows[at], columns[rows[at], slots[at]]
        if colour_of[row] < 0 and not used[column]:
            colour_of[row], used[column] = column, True
    return colour_of
