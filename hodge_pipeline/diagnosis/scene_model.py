"""A model of the scene fitted to a solution, by which other arrangements of the views are then judged.

- Joining: where every pair was tried, nearly all views that look at the same place are joined, and few others are. The
  probability is logistic in the distance between the points that two views look at, which are the origins of frames at
  the working point, and in the angle between them.
- Upright: people and vehicles carry cameras much the same way throughout, so that a part of the scene placed upside
  down is nearly always wrong. Each piece has a direction that is up in the world; in the axes of its cameras it follows
  one mixture for all pieces, von Mises and Fisher's distribution about its mean and, for the other cameras, the uniform
  one on the sphere.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import expit

from hodge_pipeline.diagnosis.evidence import CEILING, Evidence
from hodge_pipeline.diagnosis.robust_poses import Solved
from hodge_pipeline.solvers.backbone.levels import MOST_ROUNDS
from hodge_pipeline.types import Bools, Floats, Ints

USUAL, SPREAD = np.array([6.0, np.log(2.5), np.log(2.7)]), np.array([2.0, 0.5, 0.5])
"""The means of the prior on the parameters of `Joining`, and their standard deviations."""
LEAST_SPREAD_RAD = 0.2
"""Least spread of up: chained poses drift by as much, however upright the cameras were."""
CLEAR_SHARE, CLEAR_SPREAD_RAD = 0.8, 0.42
"""The least share and the largest spread of a model that is used; else its share becomes 0."""
NEIGHBOURS = 12
"""Views of a group: few enough that nearly all groups are placed rightly."""


@dataclass(frozen=True)
class Joining:
    """The model: `x (3,)` holds the log odds of two views in one place, and the logarithms of how these fall with each
    reach between the two and each radian.
    """

    reach_m: float
    x: Floats

    def between(self, first: Floats, second: Floats) -> Floats:
        """The probability (A, B) of a right edge for poses (A, 4, 4) and (B, 4, 4)."""
        fall = np.exp(self.x[1:, None, None]) * _differences(first, second, self.reach_m)
        return np.asarray(CEILING * expit(self.x[0] - fall.sum(axis=0)))


def learn_joining(poses: Floats, piece: Ints, joined: Bools, reach_m: float) -> Joining:
    """The most probable model for poses (V, 4, 4) in pieces (V,), of which the pairs `joined (V, V)` have an edge."""
    from scipy.optimize import minimize  # which takes .1 s, and not every graph needs it

    a, b = np.triu_indices(len(piece), 1)
    inside = piece[a] == piece[b]
    a, b = a[inside], b[inside]
    apart, there = _differences(poses, poses, reach_m)[:, a, b], joined[a, b].astype(float)

    def cost(x: Floats) -> tuple[float, Floats]:
        """−log of the posterior, and its gradient."""
        fall, off = np.exp(x[1:, None]) * apart, (x - USUAL) / SPREAD
        odds = x[0] - fall.sum(axis=0)
        left = expit(odds) - there
        value = (np.logaddexp(0, odds) - there * odds).sum() + off @ off / 2
        return float(value), np.array([left.sum(), *(-fall @ left)]) + off / SPREAD

    return Joining(reach_m, minimize(cost, USUAL, jac=True, method="L-BFGS-B").x)


def _differences(first: Floats, second: Floats, reach_m: float) -> Floats:
    """How far (2, A, B) poses (A, 4, 4) are from poses (B, 4, 4): in reaches, and in radians."""
    a, b = first[:, :3, 3], second[:, :3, 3]
    squares = (a * a).sum(1)[:, None] + (b * b).sum(1)[None] - 2 * a @ b.T
    trace = first[:, :3, :3].reshape(-1, 9) @ second[:, :3, :3].reshape(-1, 9).T
    angle = np.arccos(np.clip((trace - 1) / 2, -1, 1))
    return np.stack([np.sqrt(np.maximum(squares, 0.0)) / reach_m, angle])


@dataclass(frozen=True)
class Upright:
    """The distribution of the world's up in camera axes: about `up (3,)` with `concentration` for a `share` of the
    cameras, 0 where the model carries no evidence.
    """

    up: Floats
    concentration: float
    share: float

    def log_evidence(self, rotations: Floats, up: Floats) -> Floats:
        """Log-evidence (V,) of camera rotations (V, 3, 3) where up is (V, 3): 0 for the best, else negative."""
        return self._log_density(self._cosine(rotations, up)) - self._log_density(np.ones(1))

    def world_up(self, rotations: Floats, piece: Ints) -> Floats:
        """The direction (V, 3) that is up where each camera is: the one of its piece that suits the cameras there."""
        pointing, count = rotations @ self.up, int(piece.max(initial=-1)) + 1
        weight = np.ones(len(piece))
        for _ in range(MOST_ROUNDS):
            sums = [np.bincount(piece, weight * pointing[:, axis], count) for axis in range(3)]
            mean = np.stack(sums, axis=1)
            mean = mean / np.maximum(np.linalg.norm(mean, axis=1), 1e-12)[:, None]
            weight = self.following(rotations, mean[piece])
        return np.asarray(mean[piece])

    def following(self, rotations: Floats, up: Floats) -> Floats:
        """The probability (V,) that each camera follows the model."""
        return 1 - (1 - self.share) / np.exp(self._log_density(self._cosine(rotations, up)))

    def _cosine(self, rotations: Floats, up: Floats) -> Floats:
        return np.asarray(np.einsum("nij,ni,j->n", rotations, up, self.up))

    def _log_density(self, cosine: Floats) -> Floats:
        """The logarithm of the density against the uniform one."""
        peak = 2 * self.concentration / -np.expm1(-2 * self.concentration)
        return np.asarray(np.log(1 - self.share + self.share * peak * np.exp(self.concentration * (cosine - 1))))


def learn_upright(rotations: Floats, neighbours: Ints) -> Upright:
    """The most probable model of cameras (V, 3, 3) in groups (V,) of neighbours, by expectation and maximisation from
    each axis of the camera; its share is 0 where the groups do not confirm it.

    Pieces may be placed wrongly, so that all cameras together fit none; and cameras that turn freely may fit one by
    chance. Groups of neighbours do neither.
    """
    found = [_fitted_from(Upright(up, LEAST_SPREAD_RAD**-2 / 4, 0.5), rotations, neighbours) for up in np.eye(3)]
    model = max(found, key=lambda each: each[0])[1]
    clear = model.share >= CLEAR_SHARE and model.concentration >= CLEAR_SPREAD_RAD**-2
    return model if clear else replace(model, share=0.0)


def _fitted_from(model: Upright, rotations: Floats, piece: Ints) -> tuple[float, Upright]:
    """The log-likelihood, and the model that the rounds lead to."""
    up = model.world_up(rotations, piece)
    for _ in range(MOST_ROUNDS):
        follows = model.following(rotations, up)
        seen = np.einsum("nij,ni->nj", rotations, up)
        mean = follows @ seen
        total, length = max(float(follows.sum()), 1e-9), max(float(np.linalg.norm(mean)), 1e-12)
        # of von Mises and Fisher's distribution the mean length is about 1 − 1 / concentration
        spread = max(1 - length / total, 0.0) + LEAST_SPREAD_RAD**2
        model = Upright(mean / length, 1 / spread, (total + 1) / (len(piece) + 2))
        up = model.world_up(rotations, piece)
    return float(model._log_density(model._cosine(rotations, up)).sum()), model


@dataclass(frozen=True)
class SceneModel:
    """The probability of an edge by the poses of its views, and the distribution of up in camera axes."""

    joining: Joining
    upright: Upright


def learn_scene_model(evidence: Evidence, found: Solved) -> SceneModel:
    """The model fitted to the poses of a solution and the edges it uses."""
    count = len(found.piece)
    joined = np.zeros((count, count), bool)
    i, j = evidence.graph.edges[found.used].T
    joined[i, j] = joined[j, i] = True
    # consecutive views of a piece, which are placed rightly more often than all of it
    groups = np.unique(found.piece * count + np.arange(count) // NEIGHBOURS, return_inverse=True)[1].reshape(-1)
    joining = learn_joining(found.poses, found.piece, joined, evidence.reach_m)
    return SceneModel(joining, learn_upright(found.poses[:, :3, :3], groups))
