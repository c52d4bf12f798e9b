"""Out of a local minimum: one step of the Riemannian staircase (Boumal 2015; SE-Sync, section IV.B).

The rotations may turn into one more dimension, where the certificate's eigenvector leads down; from the minimum there
they are rounded back and the descent goes on. The minimum there also bounds F from below, which says how much an
escape could have won at most.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.sparse import bsr_matrix

from hodge_pipeline.solvers.certificate import Certificate, connection_matrix, lower_bound
from hodge_pipeline.solvers.newton import Descent, Limits, Point, descend
from hodge_pipeline.solvers.objective import IsotropicObjective
from hodge_pipeline.solvers.problem import Problem
from hodge_pipeline.solvers.rotations import project
from hodge_pipeline.solvers.setup import Setup
from hodge_pipeline.types import Floats

MAX_STEPS = 500
SETTLED = 1e-6
"""Relative decrease in ten steps below which the lifted descent is over: the rounding costs more."""
MAX_HALVINGS = 30
ASKEW = 0.01
"""Of the way down, added to it at random: a symmetric way can end in a saddle of its symmetry."""
LOWER = 1e-9
"""Relative decrease of F that counts as an escape."""


@dataclass(frozen=True)
class _Lifted:
    """Frames Y (n, d, d + 1), rows orthonormal, the best translations (n, d + 1), F, half its gradient by Y."""

    frames: Floats
    translations: Floats
    cost: float
    gradient: Floats


@dataclass(frozen=True)
class Escape:
    """A descent to a lower minimum, None where none was found, and what F is at least (−∞: no telling)."""

    descent: Descent | None
    bound: float


NO_WAY = Escape(None, -math.inf)


def escape(
    setup: Setup, point: Point, answer: Certificate, limits: Limits, watch: Callable[[Point], None] | None = None
) -> Escape:
    """What a step of the staircase from the point finds, the way down taken from its certificate."""
    if answer.optimal or answer.direction is None:
        return NO_WAY
    problem, d = setup.problem, setup.dimension
    matrix = connection_matrix(problem)
    frames = np.concatenate([np.swapaxes(point.rotations, 1, 2), np.zeros((problem.count, d, 1))], axis=2)
    across = np.zeros_like(frames)
    across[:, :, d] = answer.direction / np.linalg.norm(answer.direction, axis=1).max()
    across += ASKEW * np.random.default_rng(0).normal(size=across.shape)
    begin = _line_search(problem, matrix, _at(problem, matrix, frames), across, 1.0)
    if begin is None:
        return NO_WAY
    lowest = _descend(problem, matrix, begin)
    objective = IsotropicObjective(problem)
    rotations = _gauged(setup, _rounded(lowest.frames), point.rotations)
    descent = descend(objective, objective.at(rotations, point.translations), limits, setup.rounding, watch)
    if descent.point.cost < point.cost * (1 - LOWER):
        return Escape(descent, -math.inf)
    turned = np.ascontiguousarray(np.swapaxes(lowest.frames, 1, 2))
    return Escape(None, lower_bound(problem, turned, lowest.translations, lowest.cost))


def _at(problem: Problem, matrix: bsr_matrix, frames: Floats) -> _Lifted:
    n, d, r = frames.shape
    stacked = np.concatenate([frames, np.zeros((n, 1, r))], axis=1)
    image = (matrix @ stacked.reshape(-1, r)).reshape(n, d + 1, r)
    stacked[: problem.free_count, d] = -problem.translation_factor.solve(image[: problem.free_count, d])
    image = (matrix @ stacked.reshape(-1, r)).reshape(n, d + 1, r)
    return _Lifted(frames, stacked[:, d], float(np.vdot(stacked, image)), image[:, :d])


def _tangent(frames: Floats, vectors: Floats) -> Floats:
    """The part of vectors (n, d, r) along which the frames stay orthonormal."""
    product = vectors @ np.swapaxes(frames, 1, 2)
    return np.asarray(vectors - 0.5 * (product + np.swapaxes(product, 1, 2)) @ frames)


def _orthonormal(frames: Floats) -> Floats:
    """The nearest frames with orthonormal rows."""
    u, _, vt = np.linalg.svd(frames, full_matrices=False)
    return np.asarray(u @ vt)


def _line_search(
    problem: Problem, matrix: bsr_matrix, here: _Lifted, direction: Floats, scale: float
) -> _Lifted | None:
    """The first point along a direction that lies lower, the step halved each time."""
    for _ in range(MAX_HALVINGS):
        there = _at(problem, matrix, _orthonormal(here.frames + scale * direction))
        if there.cost < here.cost:
            return there
        scale *= 0.5
    return None


def _descend(problem: Problem, matrix: bsr_matrix, here: _Lifted) -> _Lifted:
    """Nonlinear conjugate gradients (Polak and Ribière) in the Laplacian's metric."""
    gradient = _tangent(here.frames, here.gradient)
    steered = _precondition(problem, gradient)
    direction, costs = -steered, [here.cost]
    for _ in range(MAX_STEPS):
        direction = _tangent(here.frames, direction)
        if np.vdot(direction, gradient) >= 0:
            direction = -_tangent(here.frames, steered)
        there = _line_search(problem, matrix, here, direction, 1.0)
        if there is None:
            break
        new = _tangent(there.frames, there.gradient)
        new_steered = _precondition(problem, new)
        denominator = float(np.vdot(gradient, steered))
        beta = max(0.0, float(np.vdot(new - gradient, new_steered)) / denominator) if denominator > 0 else 0.0
        direction = beta * direction - new_steered
        here, gradient, steered = there, new, new_steered
        costs.append(here.cost)
        if len(costs) > 10 and costs[-11] - here.cost <= SETTLED * costs[-11]:
            break
    return here


def _precondition(problem: Problem, vectors: Floats) -> Floats:
    """The inverse of the Laplacian of κ; the pinned vertices, which it lacks, follow by their own edges' weight."""
    free = problem.free_count
    out = np.empty_like(vectors)
    out[:free] = problem.rotation_factor.solve(vectors[:free].reshape(free, -1)).reshape(vectors[:free].shape)
    structure = problem.structure
    degree = (structure.at_tail @ problem.kappa + structure.at_head @ problem.kappa)[free:]
    out[free:] = vectors[free:] / np.where(degree > 0, degree, 1.0)[:, None, None]
    return out


def _rounded(frames: Floats) -> Floats:
    """The nearest rotations (n, d, d) to the frames' projection onto their d main axes (SE-Sync, algorithm 2)."""
    n, d, r = frames.shape
    _, _, axes = np.linalg.svd(frames.reshape(n * d, r), full_matrices=False)
    square = frames @ axes[:d].T
    if (np.linalg.det(square) < 0).sum() > n / 2:
        square[:, :, -1] *= -1
    return project(np.swapaxes(square, 1, 2))


def _gauged(setup: Setup, rotations: Floats, held: Floats) -> Floats:
    """The rotations with each component turned so that its pinned vertex is where it was."""
    problem = setup.problem
    component = setup.component[problem.order]
    turn = np.broadcast_to(np.eye(setup.dimension), (component.max() + 1, *held.shape[1:])).copy()
    pinned = np.arange(problem.free_count, problem.count)
    turn[component[pinned]] = held[pinned] @ np.swapaxes(rotations[pinned], 1, 2)
    return np.asarray(turn[component] @ rotations)
