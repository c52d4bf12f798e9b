"""The distribution of the world's up in camera axes, fitted to the scene: people and vehicles carry cameras much the
same way throughout, so that a part of the scene placed upside down is nearly always wrong.

Each piece has a direction that is up in the world. In the axes of its cameras it follows one mixture for all pieces:
von Mises and Fisher's distribution about its mean and, for the other cameras, the uniform one on the sphere.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from hodge_pipeline.types import Floats, Ints

LEAST_SPREAD_RAD = 0.2
"""Poses drift: chained edges are not upright to less, however the cameras were."""
FEWEST = 6
"""Views of a piece that the model is fitted to: with fewer, the unknown up of the piece fits too well."""
ROUNDS, STEPS = 8, 5
CLEAR_SHARE, CLEAR_SPREAD_RAD = 0.8, 0.42
"""Of neighbours, the least share and the largest spread of a model that is used; else its share becomes 0."""
STARTS = np.concatenate([np.eye(3), np.array([[0, a, b] for a in (1, -1) for b in (1,)]) / np.sqrt(2)])
"""Directions in camera axes from which the fit starts."""


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
        for _ in range(STEPS):
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


def learn_upright(rotations: Floats, piece: Ints, neighbours: Ints) -> Upright:
    """The model of cameras (V, 3, 3) in pieces (V,); its share is 0 unless groups (V,) of neighbours confirm it.

    Pieces may be placed wrongly, so that all cameras together fit none; and cameras that turn freely may fit one by
    chance. Groups of neighbours do neither.
    """
    model, nearby = _fitted(rotations, piece), _fitted(rotations, neighbours)
    clear = nearby.share >= CLEAR_SHARE and nearby.concentration >= CLEAR_SPREAD_RAD**-2
    return model if clear else replace(model, share=0.0)


def _fitted(rotations: Floats, piece: Ints) -> Upright:
    """The most probable model, by expectation and maximisation from several starts."""
    size = np.bincount(piece)[piece]
    enough = (size >= FEWEST) | (size == size.max())
    rotations = rotations[enough]
    piece = np.unique(piece[enough], return_inverse=True)[1].reshape(-1)
    found = [_fitted_from(Upright(up, LEAST_SPREAD_RAD**-2 / 4, 0.5), rotations, piece) for up in STARTS]
    return max(found, key=lambda each: each[0])[1]


def _fitted_from(model: Upright, rotations: Floats, piece: Ints) -> tuple[float, Upright]:
    """The log-likelihood, and the model that the rounds lead to."""
    up = model.world_up(rotations, piece)
    for _ in range(ROUNDS):
        follows = model.following(rotations, up)
        seen = np.einsum("nij,ni->nj", rotations, up)
        mean = follows @ seen
        total, length = max(float(follows.sum()), 1e-9), max(float(np.linalg.norm(mean)), 1e-12)
        # of von Mises and Fisher's distribution the mean length is about 1 − 1 / concentration
        spread = max(1 - length / total, 0.0) + LEAST_SPREAD_RAD**2
        model = Upright(mean / length, 1 / spread, (total + 1) / (len(piece) + 2))
        up = model.world_up(rotations, piece)
    return float(model._log_density(model._cosine(rotations, up)).sum()), model
