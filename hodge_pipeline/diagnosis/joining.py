"""How likely two views are joined by a right edge, from where they lie: learned from the graph itself.

Where every pair was tried, views that look at the same place are nearly all joined, and others are not. A logistic law
in the distance between the points that the views look at, and in the angle between them, says how nearly.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize

from hodge_pipeline.types import Bools, Floats, Ints

CEILING = 0.985
"""Even views that lie upon each other are not always joined."""
BASE, PER_REACH, PER_RADIAN = 6.3, 2.6, 2.7
"""What such graphs show, to begin with; the spread of what is learned about them follows."""
BASE_SPREAD, SLOPE_SPREAD, POINT_SPREAD = 2.0, 0.5, 2.0
FEWEST_PAIRS = 20


@dataclass(frozen=True)
class Joining:
    """The law: `point (3,)` in the recentred frames is what a view looks at, lengths are in units of `reach_m`."""

    reach_m: float
    point: Floats
    base: float = BASE
    per_reach: float = PER_REACH
    per_radian: float = PER_RADIAN

    def between(self, first: Floats, second: Floats) -> Floats:
        """The probability (A, B) for poses (A, 4, 4) and (B, 4, 4)."""
        a, b = self._looked_at(first), self._looked_at(second)
        apart = np.linalg.norm(a[:, None] - b[None], axis=2) / self.reach_m
        odds = self.base - self.per_reach * apart - self.per_radian * _angles(first, second)
        return np.asarray(CEILING / (1 + np.exp(-odds)))

    def _looked_at(self, poses: Floats) -> Floats:
        return np.asarray(poses[:, :3, :3] @ self.point + poses[:, :3, 3])


def _angles(first: Floats, second: Floats) -> Floats:
    trace = first[:, :3, :3].reshape(-1, 9) @ second[:, :3, :3].reshape(-1, 9).T
    return np.asarray(np.arccos(np.clip((trace - 1) / 2, -1, 1)))


def learn_joining(start: Joining, poses: Floats, piece: Ints, joined: Bools) -> Joining:
    """The likeliest law for poses (V, 4, 4) in pieces (V,) of which these pairs (V, V) are joined."""
    a, b = np.triu_indices(len(piece), 1)
    inside = piece[a] == piece[b]
    a, b = a[inside], b[inside]
    if len(a) < FEWEST_PAIRS:
        return start
    angle, seen = _angles(poses, poses)[a, b], joined[a, b].astype(float)

    def cost(x: Floats) -> float:
        at = poses[:, :3, :3] @ (x[:3] * start.reach_m) + poses[:, :3, 3]
        apart = np.linalg.norm(at[a] - at[b], axis=1) / start.reach_m
        odds = x[3] - np.exp(x[4]) * apart - np.exp(x[5]) * angle
        prior = ((x[3] - BASE) / BASE_SPREAD) ** 2 + float(x[:3] @ x[:3]) / POINT_SPREAD**2
        prior += ((x[4] - np.log(PER_REACH)) / SLOPE_SPREAD) ** 2 + ((x[5] - np.log(PER_RADIAN)) / SLOPE_SPREAD) ** 2
        return float((np.logaddexp(0, odds) - seen * odds).sum() + prior / 2)

    first = np.concatenate([start.point / start.reach_m, [BASE, np.log(PER_REACH), np.log(PER_RADIAN)]])
    x = minimize(cost, first, method="L-BFGS-B", options={"maxiter": 40}).x
    return Joining(start.reach_m, x[:3] * start.reach_m, float(x[3]), float(np.exp(x[4])), float(np.exp(x[5])))
