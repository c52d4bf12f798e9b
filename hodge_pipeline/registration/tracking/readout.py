"""The rolling-shutter read-out time, estimated from the reprojection errors of tracked frames."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.registration.tracking.reposing import view_at_stamps
from hodge_pipeline.registration.tracking.resection import resect, robust_cost
from hodge_pipeline.registration.tracking.sightings import View
from hodge_pipeline.types import Camera, Floats, Frame, Ints
from hodge_pipeline.types.arrays import evenly, groups

TRIED_S = np.linspace(0.0, 0.035, 8)
"""Seconds: video has 30 images a second, and a read-out is no longer than the time between two images."""
LONGEST_S = 1 / 30
SHORTEST_S = 0.005
"""A shorter one moves no pixel by one at 30 degrees a second; on rendered frames estimates are off by up to 2 ms."""
WIDEST = 0.5
"""Width of the interval over the value: a quarter of the shutter's effect is left at its ends."""
MOST_VIEWS = 100
"""Views used, evenly spread: each takes 10 CPU ms."""
FEWEST_KEYS = 5
"""Key frames that the bootstrap of the interval needs: it draws key frames, since views of one share its errors."""
DRAWS, INTERVAL = 500, (0.01, 0.99)
"""Draws of the bootstrap, and the quantiles of its interval."""


@dataclass(frozen=True)
class Readout:
    """Seconds: the value, and the ends of its 98 % interval."""

    best_s: float
    low_s: float
    high_s: float


def drawn_keys(count: int) -> Ints:
    """Rows (DRAWS, count) of so many key frames, drawn with replacement."""
    return np.random.default_rng(0).integers(0, count, (DRAWS, count))


def with_readout(camera: Camera, readout_s: float | None) -> Camera:
    """The camera with this read-out time; with its own one where that is None."""
    return camera if readout_s is None else replace(camera, readout_s=readout_s)


def estimate_readout(
    views: Iterable[View], frames: Sequence[Frame], world_from_cam: Floats, twists: Floats, unit_m: float
) -> Readout | None:
    """The read-out time of least reprojection error in views, their poses estimated with it.

    `twists (N, 6)`: see `shutter.velocities`. None where cameras differ, and where the minimum is not clear: near
    either end of the times tried, with too wide an interval, or with too few key frames. A camera's own read-out stands
    (None), unless none at all or its reverse surely fits better, as of images that were turned or are played backwards.
    """
    cameras = {frame.camera for frame in frames}
    camera = next(iter(cameras))
    moves = np.asarray(twists.any(axis=1))
    if len(cameras) > 1 or camera is None or not moves.any():
        return None
    own_s = camera.readout_s
    tried_s = own_s * np.array([1.0, 0.0, -1.0]) if own_s else TRIED_S
    moving = [view for view in views if moves[view.key] and moves[view.row]]
    keys, costs = list[int](), list[Floats]()
    for view in (moving[at] for at in evenly(len(moving), MOST_VIEWS)):
        start = se3.inverse(world_from_cam[view.key]) @ world_from_cam[view.row]
        cost = _costs(view, camera, tried_s, frames, twists, start, unit_m)
        if cost is not None:
            keys.append(view.key)
            costs.append(cost)
    of_key = np.array([np.sum([costs[own] for own in rows], axis=0) for _, rows in groups(np.array(keys))])
    return _in_place_of_first(of_key, tried_s) if own_s else _minimum(of_key)


def _costs(
    view: View, camera: Camera, tried_s: Floats, frames: Sequence[Frame], twists: Floats, start: Floats, unit_m: float
) -> Floats | None:
    """Robust cost (T,) of a view at each time tried."""
    costs = []
    for readout_s in tried_s.tolist():
        tried = replace(camera, readout_s=readout_s)
        points, seen = view_at_stamps(view, tried, frames, twists, start)
        found = resect(points, seen, tried, start, unit_m)
        if found is None:
            return None
        costs.append(robust_cost(points, seen, tried, found.known_from_cam, unit_m))
    return np.array(costs)


def _minimum(costs: Floats) -> Readout | None:
    """The time of least total cost (K, T), its interval by bootstrap over the K key frames; None where unclear."""
    if len(costs) < FEWEST_KEYS:
        return None
    lowest = [_vertex(costs[rows].sum(axis=0)) for rows in drawn_keys(len(costs))]
    low, high = np.quantile(lowest, INTERVAL).tolist()
    best = _vertex(costs.sum(axis=0))
    clear = low >= SHORTEST_S and high <= LONGEST_S and high - low <= WIDEST * best
    return Readout(best, low, high) if clear else None


def _in_place_of_first(costs: Floats, tried_s: Floats) -> Readout | None:
    """The time of least total cost (K, T) where that is surely less than at the first one."""
    best = int(costs.sum(axis=0).argmin())
    if len(costs) < FEWEST_KEYS or best == 0:
        return None
    more = costs[:, best] - costs[:, 0]
    surely = np.quantile(more[drawn_keys(len(costs))].sum(axis=1), INTERVAL[1]) < 0
    return Readout(*[float(tried_s[best])] * 3) if surely else None


def _vertex(costs: Floats) -> float:
    """The time of the vertex of the parabola through the least cost and its neighbours; an end where that is least."""
    at = int(np.argmin(costs))
    if at in (0, len(costs) - 1):
        return float(TRIED_S[at])
    before, least, after = costs[at - 1 : at + 2]
    step = float(TRIED_S[1] - TRIED_S[0])
    return float(TRIED_S[at] + step / 2 * (before - after) / (before - 2 * least + after))
