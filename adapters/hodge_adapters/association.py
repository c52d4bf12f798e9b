"""Which image belongs to which: by nearest stamp, and poses between the stamps of a trajectory."""

from __future__ import annotations

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.types import Floats, Ints, Trajectory

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


def interpolated_poses(trajectory: Trajectory, stamps_s: Floats, max_gap_s: float, near_s: float = 0.0) -> Floats:
    """Poses (N, 4, 4) at the stamps, on the geodesic between the two neighbours; NaN where one is farther than
    `max_gap_s`, unless the other is within `near_s`. A stamp of the trajectory itself needs no neighbours.
    """
    poses = np.full((len(stamps_s), 4, 4), np.nan)
    times = trajectory.stamps_s
    if not len(times):
        return poses
    after = np.clip(np.searchsorted(times, stamps_s), 0, len(times) - 1)
    exact = times[after] == stamps_s
    before = np.where(exact, after, np.maximum(after - 1, 0))
    to_before, to_after = stamps_s - times[before], times[after] - stamps_s
    between = (before < after) & (to_before >= 0) & (to_after >= 0)
    both_near = np.maximum(to_before, to_after) <= max_gap_s
    good = exact | (between & (both_near | (np.minimum(to_before, to_after) <= near_s)))
    span = np.where(after > before, times[after] - times[before], 1.0)
    share = to_before / span
    a, b = trajectory.world_from_cam[before[good]], trajectory.world_from_cam[after[good]]
    poses[good] = se3.interpolate(a, b, share[good])
    return poses
