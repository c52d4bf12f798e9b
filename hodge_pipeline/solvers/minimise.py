"""From a set-up to its minimum: the isotropic descent, and from there, where wanted, the full one."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import TypeAlias

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.solvers import direct
from hodge_pipeline.solvers.cg import truncated_cg
from hodge_pipeline.solvers.full_information import FullObjective
from hodge_pipeline.solvers.isotropic import CG_FIRST_TO, JointObjective, cg_first
from hodge_pipeline.solvers.newton import FAR_FROM_MINIMUM, ROUNDING_REACHED, Descent, Limits, Point, descend
from hodge_pipeline.solvers.objective import (
    IsotropicObjective,
    IsotropicPoint,
    quadratic_model,
    reduced_hessian,
    residuals,
)
from hodge_pipeline.solvers.problem import Problem
from hodge_pipeline.solvers.setup import InitialName, Setup
from hodge_pipeline.types import Floats, Ints

Watch: TypeAlias = Callable[[Point], None]
WARM_START_TOLERANCE = 1e-5
"""Relative tolerance of the isotropic optimum that starts the full objective, from which it differs by more."""

LEAST_GAIN_RATIO = 0.95
"""Least ratio of actual to predicted decrease of a full step: near the minimum, within .02 rad and .05 m, it wins .997
to 1.01 of it on five graphs of the literature, from their odometry .09 to .88.
"""

NEAR_RAD = 0.01
"""Distance from half a turn at which an edge pulls with a hundredth of its weight: a step then gains the square, 1e-4,
for less than which a descent stops.
"""
MOST_CG_STEPS, CG_TOLERANCE = 200, 1e-3
TURNS_RAD = math.pi * 0.5 ** np.arange(6)
"""Turns that are tried, in either direction: the descent direction is narrow where other edges are nearly as stiff."""


def minimise(
    setup: Setup,
    initial: InitialName,
    limits: Limits,
    full: bool,
    watch: Watch | None = None,
) -> Descent:
    """The descent of the isotropic objective and, where `full`, of the full one from its end.

    The full one is descended alone where its steps are factorisations, and from given poses where its first step gains
    `LEAST_GAIN_RATIO` of the predicted decrease. Minima at which edges miss by half a turn are left: see `turned_back`.
    """
    begin = setup.initial(initial)
    found = _minimum(setup, begin, limits, full, watch, at_once=initial == "given")
    while found.converged or found.reason == ROUNDING_REACHED:
        off = turned_back(setup.problem, found.point.rotations, found.point.translations)
        if off is None:
            break
        lower = _minimum(setup, off, limits.after(len(found.costs) - 1), full, watch, at_once=True)
        if lower.point.cost >= found.point.cost:
            break
        found = replace(lower, costs=found.costs + lower.costs[1:], cg_steps=found.cg_steps + lower.cg_steps)
    return found


def _minimum(
    setup: Setup,
    begin: tuple[Floats, Floats],
    limits: Limits,
    full: bool,
    watch: Watch | None,
    at_once: bool,
) -> Descent:
    """The descent from `begin`, which may end at a saddle; `at_once`: try the full objective first, where `full`."""
    problem = setup.problem  # where steps are by factorisations from the first the isotropic objective is no help
    alone = problem.structure.precondition is None and not cg_first(problem) and steps_are_direct(problem)
    if full and (at_once or alone):
        objective, least_won = full_objective(setup), 0.0 if alone else LEAST_GAIN_RATIO
        found = descend(objective, objective.at(*begin), limits, setup.rounding, watch, least_won=least_won)
        if found.reason != FAR_FROM_MINIMUM:
            return found
        del objective, found
    loose = max(limits.relative_tolerance, WARM_START_TOLERANCE)
    warming = Limits(limits.max_iterations // 2, loose, limits.deadline_s) if full else limits
    warm = descend_isotropic(problem, begin, warming, setup.rounding, watch)
    if not full:
        return warm
    point, steps, cg_steps = (warm.point.rotations, warm.point.translations), len(warm.costs) - 1, warm.cg_steps
    del warm, begin  # a large graph's memory is better spent on what follows
    objective = full_objective(setup)
    descent = descend(objective, objective.at(*point), limits.after(steps), setup.rounding, watch)
    return replace(descent, cg_steps=descent.cg_steps + cg_steps)


def descend_isotropic(
    problem: Problem, begin: tuple[Floats, Floats], limits: Limits, floor: float, watch: Watch | None = None
) -> Descent:
    """The descent of F from these rotations and translations, by the steps that are cheaper on this graph."""
    if joint_at_once(problem):
        joint = JointObjective.of(problem)
        return descend(joint, joint.at(*begin), limits, floor, watch)
    reduced = IsotropicObjective(problem)
    return descend(reduced, reduced.at(*begin), limits, floor, watch)


def steps_are_direct(problem: Problem) -> bool:
    """Whether a factorisation of all unknowns costs no more than a few CG steps."""
    size = problem.tangent_size + problem.dimension
    return direct.steps_worth_a_factor(problem.structure.elimination, size) <= direct.FEWEST_CG_STEPS


def joint_at_once(problem: Problem) -> bool:
    """Whether steps move all unknowns from the first, by such a factorisation or an iterative back end."""
    if problem.structure.precondition is not None:
        return True
    return problem.free_count > CG_FIRST_TO and steps_are_direct(problem)


def full_objective(setup: Setup) -> FullObjective:
    """chi² of the set-up's used edges."""
    used, information = setup.weights.used, setup.weights.information
    return FullObjective.of(setup.problem, information if used.all() else information[used])


def at_start(setup: Setup, full: bool) -> Descent:
    """A descent of no steps, for the cost at the given poses."""
    rotations, translations = setup.initial("given")
    if full:
        cost = full_objective(setup).at(rotations, translations).cost
    else:
        cost = residuals(setup.problem, rotations, translations).cost
    return Descent(Point(rotations, translations, cost), (cost,), 0, True, "")


def metrics_of(descent: Descent, full: bool) -> dict[str, float]:
    """The metrics of a descent that a solution reports."""
    return {
        "objective": descent.point.cost,
        "chi2" if full else "isotropic": descent.point.cost,
        "iterations": float(len(descent.costs) - 1),
        "cg_steps": float(descent.cg_steps),
    }


def turned_back(problem: Problem, rotations: Floats, translations: Floats) -> tuple[Floats, Floats] | None:
    """Poses of a lower F, where edges that miss by half a turn make a saddle of the given ones; else None.

    Rotations (n, d, d) and translations (n, d), in the problem's order. They are moved along the negative curvature
    that conjugate gradients meet when these edges alone pull (Steihaug 1983), turned by up to half a turn.
    """
    edges = _half_turned(problem, rotations)
    if not len(edges):
        return None
    objective = IsotropicObjective(problem)
    here = objective.at(rotations, translations)
    downhill = _downhill(problem, here, edges)
    if downhill is None:
        return None
    lowest = min((objective.moved(here, turn * downhill) for turn in (*TURNS_RAD, *-TURNS_RAD)), key=lambda p: p.cost)
    return (lowest.rotations, lowest.translations) if lowest.cost < here.cost else None


def _half_turned(problem: Problem, rotations: Floats) -> Ints:
    """The edges whose rotation misses by half a turn, nearly."""
    predicted = rotations[problem.tail] @ problem.rotations
    trace = np.einsum("eij,eij->e", rotations[problem.head], predicted)
    return np.flatnonzero(0.5 * (trace - problem.dimension + 2) < -math.cos(NEAR_RAD))


def _downhill(problem: Problem, here: IsotropicPoint, edges: Ints) -> Floats | None:
    """A direction of negative curvature (free · p,), scaled so that no edge turns by more than 1; else None."""
    p = problem.tangent_size
    axis = np.ones((len(edges), 1)) if p == 1 else se3.so3_log(here.left.turn[edges])
    pull = np.zeros((problem.count, p))
    np.add.at(pull, problem.head[edges], problem.kappa[edges, None] * axis)
    np.add.at(pull, problem.tail[edges], -problem.kappa[edges, None] * axis)
    hessian = reduced_hessian(problem, quadratic_model(problem, here.left))
    solve, free = problem.rotation_factor.solve, problem.free_count

    def precondition(r: Floats) -> Floats:
        return solve(r.reshape(free, p)).reshape(-1)

    found = truncated_cg(hessian, precondition, pull[:free].reshape(-1), CG_TOLERANCE, MOST_CG_STEPS)
    if found.downhill is None:
        return None
    direction = np.zeros((problem.count, p))
    direction[:free] = found.downhill.reshape(free, p)
    turned = np.linalg.norm(direction[problem.head[edges]] - direction[problem.tail[edges]], axis=1).max()
    return found.downhill / turned if turned > 0 else None
