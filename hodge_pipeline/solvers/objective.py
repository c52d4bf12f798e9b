"""The isotropic objective F = Σ κ‖R_j − R_i R_ij‖² + τ‖t_j − t_i − R_i t_ij‖² and its derivatives.

SE-Sync, equation 11. A rotation is turned in the world frame, R_i ← exp(ω_i^) R_i: so the Hessian of consistent edges
is the scalar Laplacian of κ on each component of ω, which is why that Laplacian preconditions it.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.sparse import bsr_matrix

from hodge_pipeline.solvers.cg import Operator, truncated_cg
from hodge_pipeline.solvers.newton import Point, Step
from hodge_pipeline.solvers.preconditioner import is_chain_like, joint_preconditioner
from hodge_pipeline.solvers.problem import Problem
from hodge_pipeline.solvers.rotations import axial, cross, exponential, lever
from hodge_pipeline.types import Floats

MAX_CG_STEPS = 1000
JOINT_AFTER_CG_STEPS = 30
"""A Newton step that needs more makes the direct factor worth its price, where that is low."""


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
    difference = (at_head - predicted).reshape(len(arm), -1)
    cost = problem.kappa * np.einsum("ek,ek->e", difference, difference)
    cost += problem.tau * np.einsum("ek,ek->e", shift, shift)
    return Residuals(at_head @ np.swapaxes(predicted, 1, 2), shift, arm, cost)


def best_translations(problem: Problem, rotations: Floats, translations: Floats) -> Floats:
    """The translations (n, d) that minimise F for these rotations; the pinned ones stay."""
    arm = np.einsum("eij,ej->ei", rotations[problem.tail], problem.translations)
    shift = problem.tau[:, None] * (translations[problem.head] - translations[problem.tail] - arm)
    force = (problem.at_head @ shift - problem.at_tail @ shift)[: problem.free_count]
    out: Floats = translations.copy()
    out[: problem.free_count] -= problem.translation_factor.solve(force)
    return out


def rotation_gradient(problem: Problem, left: Residuals) -> Floats:
    """Half the gradient of F by ω (free, p)."""
    pull = problem.kappa[:, None] * axial(left.turn)
    push = pull - problem.tau[:, None] * cross(left.shift, left.arm)
    return np.asarray(problem.at_head @ pull - problem.at_tail @ push)[: problem.free_count]


def quadratic_model(problem: Problem, left: Residuals) -> QuadraticModel:
    """The exact second-order model of F in ω at these residuals."""
    d = problem.dimension
    trace = np.einsum("eii->e", left.turn)
    if d == 2:
        full = trace[:, None, None] * problem.kappa[:, None, None]
        symmetric = full
    else:
        full = trace[:, None, None] * np.eye(3) - left.turn
        full *= problem.kappa[:, None, None]
        symmetric = 0.5 * (full + np.swapaxes(full, 1, 2))
    seen = left.shift + left.arm
    along = problem.tau * np.einsum("ek,ek->e", seen, left.arm)
    if d == 2:
        turned = along[:, None, None]
    else:
        outer = (0.5 * problem.tau)[:, None, None] * (seen[:, :, None] * left.arm[:, None, :])
        turned = along[:, None, None] * np.eye(3) - outer - np.swapaxes(outer, 1, 2)
    blocks = np.concatenate([symmetric + turned, symmetric, -full, -np.swapaxes(full, 1, 2)])
    arms = problem.tau[:, None, None] * lever(left.arm)
    coupling = problem.coupling_pattern.assemble(np.concatenate([arms, -arms]))
    return QuadraticModel(
        rotation_gradient(problem, left),
        problem.symmetric_pattern.assemble(blocks),
        coupling,
        coupling.transpose(),
    )


@dataclass(frozen=True)
class IsotropicPoint(Point):
    """A point whose translations are the best for its rotations, with its residuals."""

    left: Residuals


@dataclass
class _Joint:
    """The latest direct factor, once the Laplacian proved too weak on a graph like a chain."""

    precondition: Operator | None = None
    wanted: bool = False


@dataclass(frozen=True)
class IsotropicObjective:
    """F as a function of the rotations alone, the translations always the best ones."""

    problem: Problem
    joint: _Joint = field(default_factory=_Joint)

    def at(self, rotations: Floats, translations: Floats) -> IsotropicPoint:
        """The point at these rotations; the translations are a start for the best ones."""
        best = best_translations(self.problem, rotations, translations)
        left = residuals(self.problem, rotations, best)
        return IsotropicPoint(rotations, best, left.cost, left)

    def step(self, point: Point, tolerance: float) -> Step:
        """A truncated Newton step: each CG step costs one solve with the Laplacian of κ and one with that of τ."""
        assert isinstance(point, IsotropicPoint)
        model = quadratic_model(self.problem, point.left)
        gradient = model.gradient.reshape(-1)
        apply, precondition = reduced_hessian(self.problem, model), self._preconditioner(point)
        direction, left, steps = truncated_cg(apply, precondition, gradient, tolerance, MAX_CG_STEPS)
        self.joint.wanted = steps > JOINT_AFTER_CG_STEPS and is_chain_like(self.problem)
        slope = 2 * float(gradient @ direction)
        return Step(direction, slope, -0.5 * slope - float(direction @ left), steps)

    def _preconditioner(self, point: IsotropicPoint) -> Operator:
        if self.joint.wanted:
            self.joint.precondition = joint_preconditioner(self.problem, point.left.arm)
        if self.joint.precondition is not None:
            return self.joint.precondition
        solve, shape = self.problem.rotation_factor.solve, (self.problem.free_count, self.problem.tangent_size)
        return lambda r: solve(r.reshape(shape)).reshape(-1)

    def moved(self, point: Point, direction: Floats) -> IsotropicPoint:
        """The point whose free rotations are turned by a direction (free · p,)."""
        free = self.problem.free_count
        turned = point.rotations.copy()
        turned[:free] = exponential(direction.reshape(free, -1)) @ point.rotations[:free]
        return self.at(turned, point.translations)


def reduced_hessian(problem: Problem, model: QuadraticModel) -> Operator:
    """ω -> H ω − Cᵀ L⁻¹ C ω on vectors (free · p,)."""
    solve, shape = problem.translation_factor.solve, (problem.free_count, problem.dimension)

    def apply(omega: Floats) -> Floats:
        moved = solve((model.coupling @ omega).reshape(shape)).reshape(-1)
        return np.asarray(model.hessian @ omega - model.coupling_transpose @ moved)

    return apply
