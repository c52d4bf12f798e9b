"""Which image belongs to which, by nearest stamp."""

from __future__ import annotations

import numpy as np

from hodge_pipeline.types import Floats, Ints

NEIGHBOURS = 4
"""How many stamps on each side are looked at; more would only matter where stamps crowd within the tolerance."""


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
