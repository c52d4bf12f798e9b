"""The probability that a right edge joins two views, by their relative pose: a model fitted to the graph itself.

Where every pair was tried, nearly all views that look at the same place are joined, and few others are. The model
is logistic in the distance between the points that two views look at, and in the angle between them.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.optimize import minimize
from scipy.special import expit

from hodge_pipeline.types import Bools, Floats, Ints

CEILING = 0.97
"""Even views that lie upon each other are not always joined."""
BASE, PER_REACH, PER_RADIAN = 6.0, 2.5, 2.7
"""The means of the prior on the parameters; their standard deviations follow."""
SPREAD = np.array([2.0, 2.0, 2.0, 2.0, 0.5, 0.5])
DEPTHS = (0.0, 2.0, -2.0)
"""Of the point that is seen, along the viewing axis, to begin with."""
STEPS = 40


def _usual() -> Floats:
    return np.array([0.0, 0.0, 0.0, BASE, np.log(PER_REACH), np.log(PER_RADIAN)])


@dataclass(frozen=True)
class Joining:
    """The model: `x` holds the point that a view looks at (in units of `reach_m`), the log odds of two views in one
    place, and the logarithms of how they fall with each reach and each radian.
    """

    reach_m: float
    x: Floats = field(default_factory=_usual)

    def between(self, first: Floats, second: Floats) -> Floats:
        """The probability (A, B) of a right edge for poses (A, 4, 4) and (B, 4, 4)."""
        a, b = self._seen(first), self._seen(second)
        squares = (a * a).sum(1)[:, None] + (b * b).sum(1)[None] - 2 * a @ b.T
        apart = np.sqrt(np.maximum(squares, 0.0)) / self.reach_m
        odds = self.x[3] - np.exp(self.x[4]) * apart - np.exp(self.x[5]) * _angles(first, second)
        return np.asarray(CEILING * expit(odds))

    def _seen(self, poses: Floats) -> Floats:
        return np.asarray(poses[:, :3, :3] @ (self.reach_m * self.x[:3]) + poses[:, :3, 3])


def learn_joining(poses: Floats, piece: Ints, joined: Bools, reach_m: float, before: Joining | None = None) -> Joining:
    """The most probable model for poses (V, 4, 4) in pieces (V,), of which the pairs `joined (V, V)` have an edge.

    The search starts at `before`, where it is given.
    """
    a, b = np.triu_indices(len(piece), 1)
    inside = piece[a] == piece[b]
    a, b = a[inside], b[inside]
    turned, shifted = poses[a, :3, :3] - poses[b, :3, :3], (poses[a, :3, 3] - poses[b, :3, 3]) / reach_m
    angle, there, usual = _angles(poses, poses)[a, b], joined[a, b].astype(float), _usual()

    def cost(x: Floats) -> tuple[float, Floats]:
        """−log of the posterior, and its gradient."""
        apart = turned @ x[:3] + shifted
        distance = np.sqrt((apart * apart).sum(1) + 1e-12)
        far, turn = np.exp(x[4]) * distance, np.exp(x[5]) * angle
        odds = x[3] - far - turn
        left = expit(odds) - there
        at_point = -np.exp(x[4]) * np.einsum("n,nij,ni->j", left / distance, turned, apart)
        gradient = np.array([*at_point, left.sum(), -left @ far, -left @ turn]) + (x - usual) / SPREAD**2
        prior = float((((x - usual) / SPREAD) ** 2).sum()) / 2
        return float((np.logaddexp(0, odds) - there * odds).sum()) + prior, gradient

    starts = [before.x] if before else [usual + np.array([0, 0, depth, 0, 0, 0]) for depth in DEPTHS]
    found = [minimize(cost, x, jac=True, method="L-BFGS-B", options={"maxiter": STEPS}) for x in starts]
    return Joining(reach_m, min(found, key=lambda result: float(result.fun)).x)


def _angles(first: Floats, second: Floats) -> Floats:
    trace = first[:, :3, :3].reshape(-1, 9) @ second[:, :3, :3].reshape(-1, 9).T
    return np.asarray(np.arccos(np.clip((trace - 1) / 2, -1, 1)))
