"""Out of a local minimum: the Riemannian staircase (Boumal 2015; SE-Sync, section IV.B).

Rung by rung the rotations may turn into one more dimension, where the certificate's eigenvector leads down; from the
minimum there they are rounded back and the descent goes on. A lifted minimum that is certified bounds F from below,
which limits how much any poses could still win.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from hodge_pipeline.solvers.certificate import Certificate, certify, lower_bound
from hodge_pipeline.solvers.lifted import LiftedObjective, LiftedPoint
from hodge_pipeline.solvers.newton import Descent, Limits, Point, descend
from hodge_pipeline.solvers.objective import IsotropicObjective
from hodge_pipeline.solvers.problem import Problem
from hodge_pipeline.solvers.rotations import project
from hodge_pipeline.solvers.setup import Setup
from hodge_pipeline.types import Floats, Ints

MOST_RUNGS, MOST_CG_STEPS = 10, 2000
CG_STEPS_OF_RUNG = 100
"""At most, times the rung: valleys are straighter the higher it is, and a lower one need not be followed to its end."""
LIFTED_TOLERANCE = 1e-7
"""Relative: a bound from there is no closer than that."""
LOWER = 1e-9
"""Relative decrease of F that counts as an escape."""


@dataclass(frozen=True)
class Escape:
    """The lowest minimum found: its descent, None where it is the first one, and its certificate.

    `bound`: F is at least that, whatever the poses; −∞ where there is no telling, or no need to.
    """

    descent: Descent | None
    certificate: Certificate
    bound: float = -math.inf


def escape(
    setup: Setup, point: Point, answer: Certificate, limits: Limits, watch: Callable[[Point], None] | None
) -> Escape:
    """What the staircase finds from a point whose certificate, `answer`, does not call it optimal."""
    problem, best, lowest = setup.problem, Escape(None, answer), point.cost
    lifted = LiftedObjective.of(problem)
    loose = replace(limits, relative_tolerance=max(limits.relative_tolerance, LIFTED_TOLERANCE))
    here, cg_steps = lifted.at(np.swapaxes(point.rotations, 1, 2), point.translations), 0
    for rung in range(MOST_RUNGS):
        below = None if answer.optimal or answer.direction is None else lifted.below(here, answer.direction)
        if below is None or cg_steps > MOST_CG_STEPS or time.monotonic() > limits.deadline_s:
            break
        most = min(CG_STEPS_OF_RUNG * (rung + 1), MOST_CG_STEPS - cg_steps)
        climb = descend(lifted, below, loose, setup.rounding, most_cg_steps=most)
        cg_steps += climb.cg_steps
        won = here.cost - climb.point.cost
        here = lifted.at(climb.point.rotations, climb.point.translations)
        descent = _rounded_descent(setup, here, point, limits, watch)
        if descent.point.cost < lowest * (1 - LOWER):
            lowest = descent.point.cost
            best = Escape(descent, certify(problem, descent.point.rotations, descent.point.translations, lowest))
            if best.certificate.optimal:
                return best
        answer = certify(problem, np.ascontiguousarray(np.swapaxes(here.rotations, 1, 2)), here.translations, here.cost)
        if won < LIFTED_TOLERANCE * here.cost:
            break
    return replace(best, bound=_bound(problem, here, answer))


def _bound(problem: Problem, here: LiftedPoint, answer: Certificate) -> float:
    if answer.optimal:
        return here.cost - answer.gap_bound
    turned = np.ascontiguousarray(np.swapaxes(here.rotations, 1, 2))
    return lower_bound(problem, turned, here.translations, here.cost, answer.smallest_eigenvalue)


def _rounded_descent(
    setup: Setup, here: LiftedPoint, held: Point, limits: Limits, watch: Callable[[Point], None] | None
) -> Descent:
    """The descent of F from a lifted point's rounding, the pinned vertices where `held` has them."""
    problem, d = setup.problem, setup.dimension
    component = setup.component[problem.order]
    rotations = _rounded(here.rotations, component)
    turn = np.broadcast_to(np.eye(d), (component.max() + 1, d, d)).copy()
    pinned = np.arange(problem.free_count, problem.count)
    turn[component[pinned]] = held.rotations[pinned] @ np.swapaxes(rotations[pinned], 1, 2)
    objective = IsotropicObjective(problem)
    return descend(
        objective, objective.at(turn[component] @ rotations, held.translations), limits, setup.rounding, watch
    )


def _rounded(frames: Floats, component: Ints) -> Floats:
    """The rotations (n, d, d) nearest to the frames on their component's d main axes (SE-Sync, algorithm 2)."""
    _, d, r = frames.shape
    spread = np.zeros((component.max() + 1, r, r))
    np.add.at(spread, component, np.swapaxes(frames, 1, 2) @ frames)
    axes = np.linalg.eigh(spread)[1][:, :, -d:]
    square = frames @ axes[component]
    mirrored = np.bincount(component, np.linalg.det(square) < 0) > 0.5 * np.bincount(component)
    square[mirrored[component], :, -1] *= -1
    return project(np.swapaxes(square, 1, 2))
