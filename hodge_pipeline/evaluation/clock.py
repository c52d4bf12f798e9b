"""By how much the clock of a reference trajectory differs from that of the frames, found from how both move."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.evaluation.trajectory import absolute_error
from hodge_pipeline.types import Bools, Floats, Ints, Trajectory
from hodge_pipeline.types.arrays import rms

STEP_S = 0.3
"""Motions are compared over this time at least: a hand-held camera moves centimetres in it, ten times its error."""
GAPS = 3.0
"""Usual steps of a trajectory from which on it has a hole, over which no motion is taken."""
MOST_MOMENTS = 200_000
"""Moments on which motions are compared; a longer trajectory is sampled more coarsely."""
FEWEST_FRAMES = 10
"""With a pose, and of the reference: some motions that overlap are needed under each shift."""
BETTER = 0.5
"""A shift explains the poses if it leaves less than half of the motion, and of the error, that is left without."""
FINER = 9
"""Shifts tried about the best one: turns and places of a camera with a rolling shutter differ by some milliseconds."""
OVERLAP = 0.5
"""Share of the motion that must lie within the reference's time under a shift."""


@dataclass(frozen=True)
class Clock:
    """The reference's clock is `late_s` late; the ATE with its stamps as they are (NaN: none is near) and shifted."""

    late_s: float
    ate_m: float
    shifted_ate_m: float


def other_clock(
    world_from_cam: Floats, stamps_s: Floats, reference: Trajectory, component: Ints, arm_m: float, max_gap_s: float
) -> Clock | None:
    """The clock of a reference that explains poses (N, 4, 4) at ascending stamps (N,) clearly better when shifted.

    `component (N,)` labels frames that share a gauge; a rotation counts at `arm_m`; a pose needs the reference within
    `max_gap_s` on both sides. None where the stamps explain the poses, or no shift does.
    """
    known = se3.has_pose(world_from_cam)
    if known.sum() < FEWEST_FRAMES or (np.diff(stamps_s) <= 0).any() or len(reference) < FEWEST_FRAMES:
        return None
    near = _near_s(Trajectory(stamps_s[known], world_from_cam[known]), reference, component[known], arm_m)
    if near is None:
        return None
    shifts_s = np.array([0.0, *(near[0] + near[1] * np.linspace(-1, 1, FINER))])
    shifted = [se3.poses_at(reference, stamps_s + late_s, max_gap_s) for late_s in shifts_s]
    ates_m = np.array([absolute_error(world_from_cam, poses, component).rmse_m for poses in shifted])
    best = 1 + int(np.nan_to_num(ates_m[1:], nan=np.inf).argmin())
    places = shifted[best][se3.has_pose(shifted[best]), :3, 3]
    still_m = rms(np.linalg.norm(places - places.mean(axis=0), axis=1)) if len(places) else 0.0
    is_better = ates_m[best] < BETTER * np.nanmin([ates_m[0], still_m])
    return Clock(float(shifts_s[best]), float(ates_m[0]), float(ates_m[best])) if is_better else None


def _near_s(path: Trajectory, reference: Trajectory, component: Ints, arm_m: float) -> tuple[float, float] | None:
    """The shift with the least sum of squared differences between the motions of both, and how exact it is, seconds;
    None where none is much better than no shift.
    """
    spacing_s = float(np.median(np.diff(path.stamps_s)))
    span_s = max(np.ptp(path.stamps_s), np.ptp(reference.stamps_s))
    grid_s = max(spacing_s / 2, span_s / MOST_MOMENTS)
    apart = max(round(STEP_S / grid_s), 2)
    own, has_own = _motions(path, grid_s, apart, arm_m, component)
    other, has_other = _motions(reference, grid_s, apart, arm_m, np.zeros(len(reference), np.int64))
    if not has_own.any() or not has_other.any():
        return None
    energy = _correlated((own**2).sum(axis=1), has_other)
    cross = sum(_correlated(own[:, axis], other[:, axis]) for axis in range(6))
    missed = energy + _correlated(has_own, (other**2).sum(axis=1)) - 2 * cross
    enough = energy >= OVERLAP * (own**2).sum()
    if not enough.any() or not (own**2).sum() > 0:
        return None
    missed = np.where(enough, missed / np.maximum(energy, np.finfo(float).tiny), np.inf)
    shifts_s = reference.stamps_s[0] - path.stamps_s[0] + grid_s * np.arange(1 - len(own), len(other))
    best = int(missed.argmin())
    unshifted = np.interp(0.0, shifts_s, missed, left=np.inf, right=np.inf)
    if not missed[best] < BETTER**2 * np.fmin(unshifted, 1.0):
        return None
    return float(shifts_s[best]), grid_s


def _motions(path: Trajectory, grid_s: float, apart: int, arm_m: float, component: Ints) -> tuple[Floats, Bools]:
    """Twists (M, 6) in the camera's frame over `apart` steps of a grid from the first stamp on, 0 where unknown, and
    where known (M,).
    """
    moments = np.arange(path.stamps_s[0], path.stamps_s[-1], grid_s)
    max_gap_s = max(GAPS * float(np.median(np.diff(path.stamps_s))), grid_s)
    poses = se3.poses_at(path, moments, max_gap_s)
    of_moment = component[np.clip(np.searchsorted(path.stamps_s, moments), 0, len(component) - 1)]
    known = se3.has_pose(poses[:-apart]) & se3.has_pose(poses[apart:]) & (of_moment[:-apart] == of_moment[apart:])
    twists = np.zeros((len(known), 6))
    twists[known] = se3.log(se3.inverse(poses[:-apart][known]) @ poses[apart:][known])
    return twists * np.repeat([arm_m, 1.0], 3), known


def _correlated(own: Floats | Bools, other: Floats | Bools) -> Floats:
    """The sums over i of own[i] other[i + s], s from 1 − len(own) to len(other) − 1."""
    count = len(own) + len(other) - 1
    return np.fft.irfft(np.fft.rfft(other, count) * np.fft.rfft(own[::-1], count), count)
