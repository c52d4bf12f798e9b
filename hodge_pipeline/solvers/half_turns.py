"""Off a saddle: an edge that misses the poses by half a turn pulls neither way, so that a descent can end there."""

from __future__ import annotations

import math

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.solvers.cg import truncated_cg
from hodge_pipeline.solvers.objective import IsotropicObjective, IsotropicPoint, quadratic_model, reduced_hessian
from hodge_pipeline.solvers.problem import Problem
from hodge_pipeline.types import Floats, Ints

NEAR_RAD = 0.01
"""So near half a turn an edge pulls with a hundredth of its weight: the square, 1e-4, is what a step wins, and the
first steps of a descent stop for no more than that.
"""
MOST_CG_STEPS, CG_TOLERANCE = 200, 1e-3
TURNS_RAD = math.pi * 0.5 ** np.arange(6)
"""How far the edges are turned back, each tried both ways: the way down is narrow where others are nearly as stiff."""


def turned_back(problem: Problem, rotations: Floats, translations: Floats) -> tuple[Floats, Floats] | None:
    """Poses of a lower F, where edges that miss by half a turn make a saddle of these; None where there are none.

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
    """Of negative curvature (free · p,), the edges turning by 1 at the most; None where F only rises."""
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
    way = np.zeros((problem.count, p))
    way[:free] = found.downhill.reshape(free, p)
    turned = np.linalg.norm(way[problem.head[edges]] - way[problem.tail[edges]], axis=1).max()
    return found.downhill / turned if turned > 0 else None
