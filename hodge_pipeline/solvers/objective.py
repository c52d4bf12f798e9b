"""The isotropic objective F = Σ κ‖R_j − R_i R_ij‖² + τ‖t_j − t_i − R_i t_ij‖² and its derivatives.

SE-Sync, equation 11. A rotation is turned in the world frame, R_i ← exp(ω_i^) R_i: so the Hessian of consistent edges
is the scalar Laplacian of κ on each component of ω, which is why that Laplacian preconditions it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import bsr_matrix

from hodge_pipeline.solvers.cg import Operator, truncated_cg
from hodge_pipeline.solvers.newton import Point, Step
from hodge_pipeline.solvers.problem import Problem
from hodge_pipeline.solvers.rotations import axial, cross, exponential, lever
from hodge_pipeline.types import Floats

MAX_CG_STEPS = 1000
"""A guard: of 18 public graphs, 9 to 5750 poses, no step takes more than 24."""


@dataclass(frozen=True)
class Residuals:
    """What the edges leave: `turn (E, d, d)` = R_j (R_i R_ij)ᵀ, `shift (E, d)`, and `arm (E, d)` = R_i t_ij."""

    turn: Floats
    shift: Floats
    arm: Floats
    cost_per_edge: Floats

    @property
    def cost(self) -> float:
        """F."""
        return float(self.cost_per_edge.sum())


@dataclass(frozen=True)
class QuadraticModel:
    """½ (F(ω) − F(0)) ≈ g · ω + ½ ωᵀ H ω − ½ ωᵀ Cᵀ L⁻¹ C ω, the translations eliminated; rows are free vertices."""

    gradient: Floats
    hessian: bsr_matrix
    coupling: bsr_matrix
    coupling_transpose: bsr_matrix


def residuals(problem: Problem, rotations: Floats, translations: Floats) -> Residuals:
    """The residuals at these rotations (n, d, d) and translations (n, d)."""
    at_tail, at_head = rotations[problem.tail], rotations[problem.head]
    predicted = at_tail @ problem.rotations
    arm = np.einsum("eij,ej->ei", at_tail, problem.translations)
    shift = translations[problem.head] - translations[problem.tail] - arm
    difference = at_head - predicted
    cost = problem.kappa * np.einsum("eij,eij->e", difference, difference)
    cost += problem.tau * np.einsum("ek,ek->e", shift, shift)
    return Residuals(at_head @ np.swapaxes(predicted, 1, 2), shift, arm, cost)


def best_translations(problem: Problem, rotations: Floats, translations: Floats) -> Floats:
    """The translations (n, d) that minimise F for these rotations; the pinned ones stay."""
    out: Floats = translations.copy()
    out[: problem.free_count] -= problem.translation_factor.solve(translation_force(problem, rotations, translations))
    return out


def translation_force(problem: Problem, rotations: Floats, translations: Floats) -> Floats:
    """Half the gradient of F by the free translations (free, d)."""
    arm = np.einsum("eij,ej->ei", rotations[problem.tail], problem.translations)
    shift = problem.tau[:, None] * (translations[problem.head] - translations[problem.tail] - arm)
    return np.asarray(problem.structure.at_head @ shift - problem.structure.at_tail @ shift)[: problem.free_count]


def rotation_gradient(problem: Problem, left: Residuals) -> Floats:
    """Half the gradient of F by ω (free, p)."""
    pull = problem.kappa[:, None] * axial(left.turn)
    push = pull - problem.tau[:, None] * cross(left.shift, left.arm)
    return np.asarray(problem.structure.at_head @ pull - problem.structure.at_tail @ push)[: problem.free_count]


def gradient(problem: Problem, left: Residuals) -> Floats:
    """Half the gradient of F by rotations and translations (free, p + d)."""
    structure, force = problem.structure, problem.tau[:, None] * left.shift
    pulled = np.asarray(structure.at_head @ force - structure.at_tail @ force)[: problem.free_count]
    return np.concatenate([rotation_gradient(problem, left), pulled], axis=1)


def quadratic_model(problem: Problem, left: Residuals, exact: bool = True) -> QuadraticModel:
    """The second-order model of F in ω at these residuals; without the residuals' own curvature (Gauss-Newton), and
    so never indefinite, where it need not be exact.
    """
    p, d, structure = problem.tangent_size, problem.dimension, problem.structure
    hessian = structure.symmetric_pattern.assemble(lambda edges: curvature(problem, left, edges, exact), (p, p))

    def arms(edges: slice) -> Floats:
        levers = problem.tau[edges, None, None] * lever(left.arm[edges])
        return np.stack([levers, -levers])

    coupling = structure.coupling_pattern.assemble(arms, (d, p))
    return QuadraticModel(rotation_gradient(problem, left), hessian, coupling, coupling.transpose())


def curvature(problem: Problem, left: Residuals, edges: slice, exact: bool = True) -> Floats:
    """The blocks ii, jj, ij, ji (4, m, p, p) of some edges."""
    d, p = problem.dimension, problem.tangent_size
    kappa, tau, eye = problem.kappa[edges, None, None], problem.tau[edges, None, None], np.eye(p)
    turn, shift, arm = left.turn[edges], left.shift[edges], left.arm[edges]
    trace = np.einsum("eii->e", turn)[:, None, None]
    mixed = kappa * (trace * eye - turn if d == 3 else trace)
    turned = 0.5 * (mixed + np.swapaxes(mixed, 1, 2)) if exact else 2 * kappa * eye
    seen = shift + arm if exact else arm
    levered = tau * np.einsum("ek,ek->e", seen, arm)[:, None, None] * eye
    if d == 3:
        outer = (0.5 * tau) * (seen[:, :, None] * arm[:, None, :])
        levered -= outer + np.swapaxes(outer, 1, 2)
    return np.stack([turned + levered, turned, -mixed, -np.swapaxes(mixed, 1, 2)])


@dataclass(frozen=True)
class IsotropicPoint(Point):
    """A point with its residuals."""

    left: Residuals


@dataclass(frozen=True)
class IsotropicObjective:
    """F as a function of the rotations alone, the translations always the best ones."""

    problem: Problem

    def at(self, rotations: Floats, translations: Floats) -> IsotropicPoint:
        """The point at these rotations; the translations are a start for the best ones."""
        best = best_translations(self.problem, rotations, translations)
        left = residuals(self.problem, rotations, best)
        return IsotropicPoint(rotations, best, left.cost, left)

    def step(self, point: Point, tolerance: float, enough: float) -> Step:
        """A truncated Newton step: each CG step costs one solve with the Laplacian of κ and one with that of τ.

        Where the Hessian has a direction of negative curvature, the Gauss-Newton model takes its place: far from the
        minimum of a long chain its steps go ten times as far.
        """
        assert isinstance(point, IsotropicPoint)
        spent = 0
        for exact in (True, False):
            model = quadratic_model(self.problem, point.left, exact)
            gradient = model.gradient.reshape(-1)
            hessian = reduced_hessian(self.problem, model)
            found = truncated_cg(hessian, self._precondition, gradient, tolerance, MAX_CG_STEPS, enough)
            spent += found.steps
            if not found.negative_curvature:
                break
        slope = 2 * float(gradient @ found.x)
        return Step(found.x, slope, -0.5 * slope - float(found.x @ found.residual), spent)

    def _precondition(self, r: Floats) -> Floats:
        shape = (self.problem.free_count, self.problem.tangent_size)
        return self.problem.rotation_factor.solve(r.reshape(shape)).reshape(-1)

    def moved(self, point: Point, direction: Floats) -> IsotropicPoint:
        """The point whose free rotations are turned by a direction (free · p,)."""
        free = self.problem.free_count
        turned = point.rotations.copy()
        turned[:free] = exponential(direction.reshape(free, self.problem.tangent_size)) @ point.rotations[:free]
        return self.at(turned, point.translations)


def reduced_hessian(problem: Problem, model: QuadraticModel) -> Operator:
    """ω -> H ω − Cᵀ L⁻¹ C ω on vectors (free · p,)."""
    solve, shape = problem.translation_factor.solve, (problem.free_count, problem.dimension)

    def apply(omega: Floats) -> Floats:
        moved = solve((model.coupling @ omega).reshape(shape)).reshape(-1)
        return np.asarray(model.hessian @ omega - model.coupling_transpose @ moved)

    return apply
