"""From a set-up to its minimum: the isotropic descent, and from there, where wanted, the full one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TypeAlias

from hodge_pipeline.solvers.direct import steps_worth_a_factor
from hodge_pipeline.solvers.full import FEWEST_CG_STEPS, FullObjective
from hodge_pipeline.solvers.joint import JointObjective
from hodge_pipeline.solvers.newton import Descent, Limits, Objective, Point, descend
from hodge_pipeline.solvers.objective import IsotropicObjective, residuals
from hodge_pipeline.solvers.problem import Problem
from hodge_pipeline.solvers.setup import InitialName, Setup

Watch: TypeAlias = Callable[[Point], None]
WARM_START_TOLERANCE = 1e-5
"""The isotropic optimum starts the full objective: nearer than this they differ anyway."""


def minimise(
    setup: Setup, initial: InitialName, limits: Limits, full: bool, watch: Watch | None = None, *, known: bool = False
) -> Descent:
    """The descent of the isotropic objective and, where `full`, of the full one from its end.

    `known`: the initial poses are near the full minimum already, so that it begins there; it does so too where its
    steps cost no more than isotropic ones.
    """
    begin = setup.initial(initial)
    if full and (known or steps_are_direct(setup.problem)):
        objective = full_objective(setup)
        return descend(objective, objective.at(*begin), limits, setup.rounding, watch)
    isotropic = isotropic_objective(setup.problem)
    loose = replace(limits, relative_tolerance=max(limits.relative_tolerance, WARM_START_TOLERANCE))
    warm = descend(isotropic, isotropic.at(*begin), loose if full else limits, setup.rounding, watch)
    if not full:
        return warm
    point, steps, cg_steps = (warm.point.rotations, warm.point.translations), len(warm.costs) - 1, warm.cg_steps
    del isotropic, warm, begin  # a large graph's memory is better spent on what follows
    objective = full_objective(setup)
    descent = descend(objective, objective.at(*point), limits.after(steps), setup.rounding, watch)
    return replace(descent, cg_steps=descent.cg_steps + cg_steps)


def isotropic_objective(problem: Problem) -> Objective:
    """F, in the form whose steps are the cheaper ones on this graph."""
    return JointObjective.of(problem) if steps_are_direct(problem) else IsotropicObjective(problem)


def steps_are_direct(problem: Problem) -> bool:
    """Whether a factorisation of all unknowns is so cheap that CG is not tried."""
    size = problem.tangent_size + problem.dimension
    return steps_worth_a_factor(problem.structure.elimination, size) <= FEWEST_CG_STEPS


def full_objective(setup: Setup) -> FullObjective:
    """chi² of the set-up's used edges."""
    used, information = setup.weights.used, setup.weights.information
    return FullObjective.of(setup.problem, information if used.all() else information[used])


def cost_at_start(setup: Setup, full: bool) -> float:
    """The objective at the given poses."""
    given = setup.initial("given")
    return full_objective(setup).at(*given).cost if full else residuals(setup.problem, *given).cost


def metrics_of(descent: Descent, full: bool) -> dict[str, float]:
    """What a solution says of its descent."""
    return {
        "objective": descent.point.cost,
        "chi2" if full else "isotropic": descent.point.cost,
        "iterations": float(len(descent.costs) - 1),
        "cg_steps": float(descent.cg_steps),
        "converged": float(descent.converged),
    }
