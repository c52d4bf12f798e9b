"""The descent that both objectives share: a truncated Newton step, a line search along it, and when to stop."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from hodge_pipeline.types import Floats

SUFFICIENT_DECREASE = 1e-4
"""Armijo's constant, as Nocedal and Wright have it."""
MAX_HALVINGS = 40
"""To a trillionth of the step, whose change of the cost is rounding."""
CG_LIMIT_REACHED = "limit of CG steps reached"
TIME_LIMIT_REACHED, ITERATION_LIMIT_REACHED = "time limit reached", "iteration limit reached"
ROUNDING_REACHED = "no further decrease within rounding"
FAR_FROM_MINIMUM = "the first step wins less than it promises"
CG_SHARE = 0.1
"""Of what further steps may still win: where so little is left in a linear system, it is solved."""
LOOSEST_TOLERANCE, TIGHTEST_TOLERANCE = 0.05, 1e-3
"""Relative residual of a linear system, at first and near the minimum, where steps become exact (Dembo et al. 1982)."""


@dataclass(frozen=True)
class Limits:
    """When to stop: after so many steps, at so small a relative decrease, or at this `time.monotonic()`."""

    max_iterations: int
    relative_tolerance: float
    deadline_s: float = math.inf

    def after(self, used: int) -> Limits:
        """What is left of them after some steps."""
        return Limits(max(self.max_iterations - used, 0), self.relative_tolerance, self.deadline_s)


@dataclass(frozen=True)
class Point:
    """Poses in the problem's order, and the objective there."""

    rotations: Floats
    translations: Floats
    cost: float


@dataclass(frozen=True)
class Step:
    """A descent direction; `slope` = dF/ds at 0, `predicted` = the decrease that the model promises."""

    direction: Floats
    slope: float
    predicted: float
    cg_steps: int


class Objective(Protocol):
    """A cost on poses with its truncated Newton steps."""

    def at(self, rotations: Floats, translations: Floats) -> Point:
        """The point at these poses."""

    def step(self, point: Point, tolerance: float, enough: float) -> Step:
        """The step from a point, its linear system solved to a relative tolerance, or until it wins too little."""

    def moved(self, point: Point, direction: Floats) -> Point:
        """The point reached along a direction."""


@dataclass(frozen=True)
class Descent:
    """Where a descent ended, the objective on the way, and why it stopped before it converged, else an empty word."""

    point: Point
    costs: tuple[float, ...]
    cg_steps: int
    converged: bool
    reason: str


def descend(
    objective: Objective,
    point: Point,
    limits: Limits,
    floor: float,
    watch: Callable[[Point], None] | None = None,
    most_cg_steps: float = math.inf,
    least_won: float = 0.0,
) -> Descent:
    """The descent from a point. A cost or decrease below `floor` is rounding: there is nothing left to win.

    It ends, not converged, once it has taken more than `most_cg_steps`, and where the first step wins less than a share
    `least_won` of what its model promises.
    """
    costs, cg_steps, tolerance, before = [point.cost], 0, LOOSEST_TOLERANCE, math.inf
    for _ in range(limits.max_iterations):
        if point.cost <= floor:
            return Descent(point, tuple(costs), cg_steps, True, "")
        smallest = limits.relative_tolerance * point.cost + floor
        step = objective.step(point, tolerance, CG_SHARE * smallest)
        cg_steps += step.cg_steps
        new = _line_search(objective, point, step)
        if len(costs) == 1 and point.cost - (new or point).cost < least_won * step.predicted - floor:
            return Descent(point, tuple(costs), cg_steps, False, FAR_FROM_MINIMUM)
        if new is None:
            converged = step.predicted <= math.sqrt(limits.relative_tolerance) * point.cost
            return Descent(point, tuple(costs), cg_steps, converged, ROUNDING_REACHED)
        decrease, point = point.cost - new.cost, new
        costs.append(point.cost)
        if watch is not None:
            watch(point)
        if still_to_come(max(step.predicted, decrease), before, tolerance**2) <= smallest:
            return Descent(point, tuple(costs), cg_steps, True, "")
        if time.monotonic() > limits.deadline_s:
            return Descent(point, tuple(costs), cg_steps, False, TIME_LIMIT_REACHED)
        if cg_steps > most_cg_steps:
            return Descent(point, tuple(costs), cg_steps, False, CG_LIMIT_REACHED)
        before = decrease
        tolerance = min(LOOSEST_TOLERANCE, max(TIGHTEST_TOLERANCE, math.sqrt(max(decrease, 0.0) / costs[-2])))
    return Descent(point, tuple(costs), cg_steps, False, ITERATION_LIMIT_REACHED)


def still_to_come(decrease: float, before: float, least_share: float) -> float:
    """What further steps may win: the decreases go on shrinking as they did, and each leaves a share at the least."""
    share = max(least_share, decrease / before) if before > 0 else 1.0
    return decrease * share / (1 - share) if share < 1 else math.inf


def _line_search(objective: Objective, point: Point, step: Step) -> Point | None:
    scale = 1.0
    for _ in range(MAX_HALVINGS):
        new = objective.moved(point, scale * step.direction)
        if new.cost <= point.cost + SUFFICIENT_DECREASE * scale * step.slope:
            return new
        scale *= 0.5
    return None
