"""The distribution of the world's up in camera axes, fitted to the scene: people and vehicles carry cameras much the
same way throughout, so that a part of the scene placed upside down is nearly always wrong.

Each piece has a direction that is up in the world. In the axes of its cameras it follows one mixture for all pieces: a
Gaussian in the tangent plane of its mean, wider in pitch than in roll, and, for the other cameras, uniform on the
sphere.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from hodge_pipeline.types import Floats, Ints

DIRECTIONS = 200
DENSE = 10.0
"""Concentration of the kernel that finds where directions are dense: about 25°."""
LEAST_SPREAD_RAD = 0.2
"""Poses drift: chained edges are not upright to less, however the cameras were."""
FEWEST = 6
"""Views of a piece that the model is fitted to: with fewer, the unknown up of the piece fits too well."""
ROUNDS, STEPS = 8, 3
OUTLYING = 4.0
"""Standard deviations beyond which a camera hardly counts in the estimate of up."""
CLEAR_SHARE, CLEAR_SPREAD_RAD = 0.8, 0.42
"""Of neighbours, the least share and the largest spread of a model that is used; else its share becomes 0."""


@dataclass(frozen=True)
class Upright:
    """The distribution of the world's up in camera axes: `up (3,)`, `tangent (2, 3)`, `precision (2, 2)`, and the
    `share` of cameras in the Gaussian, 0 where the model carries no evidence.
    """

    up: Floats
    tangent: Floats
    precision: Floats
    share: float

    def log_evidence(self, rotations: Floats, up: Floats) -> Floats:
        """Log-evidence (V,) of camera rotations (V, 3, 3) where up is (V, 3): 0 for the best, else negative."""
        return self._log_density(np.einsum("nji,nj->ni", rotations, up)) - self._log_of(np.zeros(1))

    def world_up(self, rotations: Floats, piece: Ints) -> Floats:
        """The direction (V, 3) that is up where each camera is: the one of its piece that suits the cameras there."""
        out, directions = np.zeros((len(piece), 3)), _directions()
        for name in np.unique(piece):
            rows = np.flatnonzero(piece == name)
            seen = np.tensordot(directions, rotations[rows], (1, 1))
            out[rows] = self._settled(rotations[rows], directions[int(np.argmax(self._log_density(seen).sum(1)))])
        return out

    def local(self, seen: Floats) -> tuple[Floats, Floats]:
        """Where in the tangent plane (..., 2) directions (..., 3) lie, by their angle, and their χ² (...,)."""
        flat = seen @ self.tangent.T
        length = np.linalg.norm(flat, axis=-1)
        angle = np.arctan2(length, seen @ self.up)
        local = flat * (angle / np.maximum(length, 1e-12))[..., None]
        return local, np.einsum("...a,ab,...b->...", local, self.precision, local)

    def following(self, seen: Floats) -> Floats:
        """The probability (V,) that cameras which see up in these directions (V, 3) follow the model."""
        return 1 - (1 - self.share) / np.exp(self._log_density(seen))

    def _settled(self, rotations: Floats, up: Floats) -> Floats:
        """Gauss–Newton steps to where up (3,) suits the cameras that nearly follow the model."""
        for _ in range(STEPS):
            local, squares = self.local(np.einsum("nji,j->ni", rotations, up))
            weight, across = 1 / (1 + squares / OUTLYING**2), _tangent(up)
            slope = np.einsum("ai,nji,bj->nab", self.tangent, rotations, across)
            normal = np.einsum("n,nca,cd,ndb->ab", weight, slope, self.precision, slope)
            pull = np.einsum("n,nca,cd,nd->a", weight, slope, self.precision, local)
            up = up - np.linalg.solve(normal + (1e-9 * np.trace(normal) + 1e-12) * np.eye(2), pull) @ across
            up = up / np.linalg.norm(up)
        return up

    def _log_density(self, seen: Floats) -> Floats:
        return self._log_of(self.local(seen)[1])

    def _log_of(self, squares: Floats) -> Floats:
        """The logarithm of the density against the uniform one."""
        peak = 2 * np.sqrt(np.linalg.det(self.precision))
        return np.asarray(np.log(1 - self.share + self.share * peak * np.exp(-squares / 2)))


def learn_upright(rotations: Floats, piece: Ints, neighbours: Ints) -> Upright:
    """The model of cameras (V, 3, 3) in pieces (V,); its share is 0 unless groups (V,) of neighbours confirm it.

    Pieces may be placed wrongly, so that all cameras together fit none; and cameras that turn freely may fit one by
    chance. Groups of neighbours do neither.
    """
    model, nearby = _fitted(rotations, piece), _fitted(rotations, neighbours)
    spread = np.sqrt(1 / np.linalg.eigvalsh(nearby.precision)[0])
    clear = nearby.share >= CLEAR_SHARE and spread <= CLEAR_SPREAD_RAD
    return model if clear else replace(model, share=0.0)


def _fitted(rotations: Floats, piece: Ints) -> Upright:
    """The most probable model, by expectation and maximisation."""
    size = np.bincount(piece)[piece]
    enough = (size >= FEWEST) | (size == size.max())
    rotations, piece, size = rotations[enough], piece[enough], size[enough]
    model = _densest(rotations[piece == piece[np.argmax(size)]])
    for _ in range(ROUNDS):
        seen = np.einsum("nji,nj->ni", rotations, model.world_up(rotations, piece))
        follows = model.following(seen)
        total = max(float(follows.sum()), 1e-9)
        up = follows @ seen
        up /= max(float(np.linalg.norm(up)), 1e-12)
        model = Upright(up, _tangent(up), np.eye(2), (total + 1) / (len(piece) + 2))
        local = model.local(seen)[0]
        spread = np.einsum("n,na,nb->ab", follows, local, local) / total + LEAST_SPREAD_RAD**2 * np.eye(2)
        model = replace(model, precision=np.linalg.inv(spread))
    return model


def _densest(rotations: Floats) -> Upright:
    """A wide model about the direction in camera axes that most cameras of one piece can share."""
    seen = np.tensordot(_directions(), rotations, (1, 1))
    near = np.exp(DENSE * (seen @ seen.swapaxes(1, 2) - 1))
    world, view = np.unravel_index(int(np.argmax(near.sum(2))), near.shape[:2])
    up = near[world, view] @ seen[world]
    up /= np.linalg.norm(up)
    return Upright(up, _tangent(up), DENSE * np.eye(2), 0.5)


def _tangent(up: Floats) -> Floats:
    """Two unit vectors (2, 3) at right angles to one."""
    return np.asarray(np.linalg.svd(up[None])[2][1:])


def _directions() -> Floats:
    """Directions (DIRECTIONS, 3) evenly on the sphere, along a spiral."""
    number = np.arange(DIRECTIONS) + 0.5
    height, turn = 1 - 2 * number / DIRECTIONS, np.pi * (1 + np.sqrt(5)) * number
    ring = np.sqrt(1 - height**2)
    return np.stack([ring * np.cos(turn), ring * np.sin(turn), height], axis=1)
