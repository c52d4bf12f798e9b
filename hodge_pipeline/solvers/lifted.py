"""F with rotations that may turn into more dimensions, where it has fewer local minima (Boumal 2015; SE-Sync, IV.B).

A vertex's rotation becomes a frame: d orthonormal rows in a space of r ≥ d dimensions. F = tr(Yᵀ Q Y) as before, the
translations, which live in that space too, eliminated. It is never turned as a whole: no vertex is pinned.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.sparse import bsr_matrix

from hodge_pipeline.solvers.certificate import connection_matrix, definite_inverse
from hodge_pipeline.solvers.cg import truncated_cg
from hodge_pipeline.solvers.newton import Point, Step
from hodge_pipeline.solvers.problem import Problem
from hodge_pipeline.types import Floats

MAX_CG_STEPS = 300
"""Of a Newton step: a step that ends there is short but goes downhill."""
MAX_HALVINGS = 30
"""Of the way out of a saddle: beyond 2⁻³⁰ of a radian the cost changes by less than its rounding."""


@dataclass(frozen=True)
class LiftedPoint(Point):
    """A point whose `rotations (n, d, r)` are frames and whose translations (n, r) are the best for them.

    `image (n, d, r)` is Q Y: half the gradient before its projection.
    """

    image: Floats

    @property
    def multiplier(self) -> Floats:
        """Λ (n, d, d), that of the frames' orthonormality."""
        product = self.image @ np.swapaxes(self.rotations, 1, 2)
        return np.asarray(0.5 * (product + np.swapaxes(product, 1, 2)))


@dataclass(frozen=True)
class LiftedObjective:
    """F of frames, with its Newton steps; `matrix` is that of F with the translations (SE-Sync, equation 15)."""

    problem: Problem
    matrix: bsr_matrix

    @classmethod
    def of(cls, problem: Problem) -> LiftedObjective:
        """The lifted F of a problem."""
        return cls(problem, connection_matrix(problem))

    def at(self, rotations: Floats, translations: Floats) -> LiftedPoint:
        """The point at these frames (n, d, r); the translations follow from them, whatever was given."""
        image, best = self._reduced(rotations)
        return LiftedPoint(rotations, best, float(np.vdot(rotations, image)), image)

    def step(self, point: Point, tolerance: float, enough: float) -> Step:
        """A truncated Newton step, and where F curves down, as far along that as it leads down."""
        assert isinstance(point, LiftedPoint)
        frames, multiplier = point.rotations, point.multiplier
        gradient = tangent(frames, point.image).reshape(-1)
        inverse = definite_inverse(self.problem, self.matrix, multiplier)

        def hessian(x: Floats) -> Floats:
            along = x.reshape(frames.shape)
            return tangent(frames, self._reduced(along)[0] - multiplier @ along).reshape(-1)

        def precondition(r: Floats) -> Floats:
            return tangent(frames, inverse(r.reshape(frames.shape))).reshape(-1)

        found = truncated_cg(hessian, precondition, gradient, tolerance, MAX_CG_STEPS, enough)
        x = found.x
        if found.downhill is not None:
            x = x if found.steps > 1 else np.zeros_like(x)
            x = x + self._length(point, x, found.downhill) * found.downhill
        slope = 2 * float(gradient @ x)
        return Step(x, slope, -0.5 * slope - float(x @ found.residual), found.steps)

    def _length(self, point: LiftedPoint, x: Floats, downhill: Floats) -> float:
        """How far along a direction from x the cost falls: the length is halved from a radian until it rises again."""
        length = 1.0 / float(np.linalg.norm(downhill.reshape(len(point.rotations), -1), axis=1).max())
        before = math.inf
        for _ in range(MAX_HALVINGS):
            cost = self.moved(point, x + length * downhill).cost
            if before < point.cost and cost >= before:
                return 2 * length
            before, length = cost, (0.5 if cost < point.cost else 0.25) * length
        return length

    def moved(self, point: Point, direction: Floats) -> LiftedPoint:
        """The point whose frames are moved by a direction (n · d · r,) and made orthonormal again."""
        moved = point.rotations + direction.reshape(point.rotations.shape)
        values, axes = np.linalg.eigh(moved @ np.swapaxes(moved, 1, 2))
        inverse_root = (axes / np.sqrt(values)[:, None]) @ np.swapaxes(axes, 1, 2)
        return self.at(inverse_root @ moved, point.translations)

    def below(self, point: LiftedPoint, direction: Floats) -> LiftedPoint | None:
        """The lowest point on the way from a saddle along a direction (n, d) into one more dimension, None if none is.

        The way's length is tried in halves of that where the vertex which moves most has turned by a radian.
        """
        n, d, r = point.rotations.shape
        frames = np.concatenate([point.rotations, np.zeros((n, d, 1))], axis=2)
        across = np.zeros_like(frames)
        across[:, :, r] = direction / np.linalg.norm(direction, axis=1).max()
        here = self.at(frames, point.translations)
        flat = across.reshape(-1)
        there = self.moved(here, self._length(here, np.zeros_like(flat), flat) * flat)
        return there if there.cost < here.cost else None

    def _reduced(self, vectors: Floats) -> tuple[Floats, Floats]:
        """Q times vectors (n, d, r), and the translations (n, r) that go with them."""
        n, d, r = vectors.shape
        free = self.problem.free_count
        stacked = np.concatenate([vectors, np.zeros((n, 1, r))], axis=1)
        image = (self.matrix @ stacked.reshape(-1, r)).reshape(n, d + 1, r)
        stacked[:free, d] = -self.problem.translation_factor.solve(image[:free, d])
        image = (self.matrix @ stacked.reshape(-1, r)).reshape(n, d + 1, r)
        return image[:, :d], stacked[:, d]


def tangent(frames: Floats, vectors: Floats) -> Floats:
    """The part of vectors (n, d, r) along which the frames stay orthonormal."""
    product = vectors @ np.swapaxes(frames, 1, 2)
    return np.asarray(vectors - 0.5 * (product + np.swapaxes(product, 1, 2)) @ frames)
