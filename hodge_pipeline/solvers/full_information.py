"""The full objective: chi² = Σ rᵀ Ω r with the 6x6 information of each edge in its own frame, by Gauss-Newton.

r = (2 q_vec, t) of (R_ij, t_ij)⁻¹ (T_i⁻¹ T_j), which is g2o's residual in radians; (θ, x, y) in the plane.
Poses are moved in the world frame: R_i ← exp(ω_i^) R_i, t_i ← t_i + v_i.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import bsr_matrix
from scipy.spatial.transform import Rotation

from hodge_pipeline import se3
from hodge_pipeline.solvers.cg import Operator, truncated_cg
from hodge_pipeline.solvers.direct import DirectSolver
from hodge_pipeline.solvers.isotropic import step_solver
from hodge_pipeline.solvers.iterative import IterativeSolver
from hodge_pipeline.solvers.newton import Point, Step
from hodge_pipeline.solvers.problem import Problem
from hodge_pipeline.solvers.rotations import lever
from hodge_pipeline.types import Floats


@dataclass(frozen=True)
class FullResiduals:
    """`residual (E, p + d)`; dr / d(ω, v) in world axes as its blocks `turn (E, p, p)` and the transpose of
    `predicted (E, d, d)` = R_i R_ij; `reach (E, d)` = t_j − t_i.
    """

    residual: Floats
    turn: Floats
    predicted: Floats
    reach: Floats
    cost_per_edge: Floats


@dataclass(frozen=True)
class FullPoint(Point):
    """A point with its residuals."""

    left: FullResiduals


def full_residuals(problem: Problem, information: Floats, rotations: Floats, translations: Floats) -> FullResiduals:
    """The residuals at these rotations (n, d, d) and translations (n, d)."""
    d, p = problem.dimension, problem.tangent_size
    at_tail, at_head = rotations[problem.tail], rotations[problem.head]
    predicted = at_tail @ problem.rotations
    error = np.swapaxes(predicted, 1, 2) @ at_head
    reach = translations[problem.head] - translations[problem.tail]
    missed = reach - np.einsum("eij,ej->ei", at_tail, problem.translations)
    residual = np.empty((len(reach), p + d))
    residual[:, p:] = np.einsum("eji,ej->ei", predicted, missed)
    if d == 2:
        residual[:, 0] = np.arctan2(error[:, 1, 0], error[:, 0, 0])
        turn = np.ones((len(reach), 1, 1))
    else:
        quat = Rotation.from_matrix(error).as_quat()
        quat = np.where(quat[:, 3:] < 0, -quat, quat)
        residual[:, :3] = 2 * quat[:, :3]
        turn = (quat[:, 3, None, None] * np.eye(3) + se3.hat(quat[:, :3])) @ np.swapaxes(at_head, 1, 2)
    cost = np.einsum("ei,ei->e", residual, np.einsum("eij,ej->ei", information, residual))
    return FullResiduals(residual, turn, predicted, reach, cost)


@dataclass(frozen=True)
class FullObjective:
    """chi² of a problem with its information (E, p + d, p + d) over (rotation, translation)."""

    problem: Problem
    information: Floats
    solver: DirectSolver | IterativeSolver

    @classmethod
    def of(cls, problem: Problem, information: Floats) -> FullObjective:
        """The objective of a problem."""
        return cls(problem, information, step_solver(problem))

    def at(self, rotations: Floats, translations: Floats) -> FullPoint:
        """The point at these poses."""
        left = full_residuals(self.problem, self.information, rotations, translations)
        return FullPoint(rotations, translations, float(left.cost_per_edge.sum()), left)

    def step(self, point: Point, tolerance: float, enough: float) -> Step:
        """A Gauss-Newton step by PCG: first with the two Laplacians, with a direct factor once they prove too weak."""
        assert isinstance(point, FullPoint)
        if isinstance(self.solver, IterativeSolver):
            self.solver.look(self.problem.tau, point.left.reach)
        gradient, hessian = self.normal_equations(point.left)
        spent, tried = 0, self.solver.steps_to_try(hessian.blocksize[0])
        if tried:
            apply, precondition = (lambda x: np.asarray(hessian @ x)), self.laplacian_preconditioner(point.rotations)
            found = truncated_cg(apply, precondition, gradient, tolerance, tried, enough)
            spent = found.steps
            self.solver.tried += spent
        if spent >= tried:
            found = self.solver.solve(
                hessian, gradient, tolerance, enough, point.translations[: self.problem.free_count]
            )
            spent += found.steps
        slope = 2 * float(gradient @ found.x)
        return Step(found.x, slope, -0.5 * slope - float(found.x @ found.residual), spent)

    def moved(self, point: Point, direction: Floats) -> FullPoint:
        """The point whose free poses are moved by a direction (free · (p + d),)."""
        return self.at(*self.problem.moved(point.rotations, point.translations, direction))

    def normal_equations(self, left: FullResiduals) -> tuple[Floats, bsr_matrix]:
        """Half the gradient (free · (p + d),) and half the Gauss-Newton Hessian."""
        problem, p = self.problem, self.problem.tangent_size
        structure, size = problem.structure, problem.tangent_size + problem.dimension
        at_tail, at_head = np.empty((2, len(problem.tail), size))

        def blocks(edges: slice) -> Floats:
            frame = _frame(left, edges)
            weighted = np.swapaxes(frame, 1, 2) @ self.information[edges]
            core = weighted @ frame
            force = np.einsum("eij,ej->ei", weighted, left.residual[edges])
            arm = lever(left.reach[edges])
            at_head[edges] = at_tail[edges] = force
            at_tail[edges, :p] -= np.einsum("eji,ej->ei", arm, force[:, p:])
            half = core.copy()
            half[:, :, :p] -= core[:, :, p:] @ arm
            tail_tail = half.copy()
            tail_tail[:, :p] -= np.swapaxes(arm, 1, 2) @ half[:, p:]
            return np.stack([tail_tail, core, -np.swapaxes(half, 1, 2), -half])

        hessian = structure.symmetric_pattern.assemble(blocks, (size, size))
        gradient = (structure.at_head @ at_head - structure.at_tail @ at_tail)[: problem.free_count]
        return gradient.reshape(-1), hessian

    def laplacian_preconditioner(self, rotations: Floats) -> Operator:
        """The isotropic Hessian of consistent edges, inverted exactly up to the levers' share of the rotations."""
        problem = self.problem
        p, d, free = problem.tangent_size, problem.dimension, problem.free_count

        def levers(edges: slice) -> Floats:
            arm = np.einsum("eij,ej->ei", rotations[problem.tail[edges]], problem.translations[edges])
            arms = problem.tau[edges, None, None] * lever(arm)
            return np.stack([arms, -arms])

        coupling = problem.structure.coupling_pattern.assemble(levers, (d, p))
        back = coupling.transpose()
        rotation, translation = problem.rotation_factor.solve, problem.translation_factor.solve
        rotation_scale = 2.0 if d == 3 else 1.0

        def apply(r: Floats) -> Floats:
            parts = r.reshape(free, p + d)
            moved = translation(parts[:, p:])
            turned = rotation(parts[:, :p] - (back @ moved.reshape(-1)).reshape(free, p)) / rotation_scale
            moved -= translation((coupling @ turned.reshape(-1)).reshape(free, d))
            return np.concatenate([turned, moved], axis=1).reshape(-1)

        return apply


def _frame(left: FullResiduals, edges: slice) -> Floats:
    """The derivative of r by (ω, v) (m, p + d, p + d) in world axes."""
    turn, predicted = left.turn[edges], left.predicted[edges]
    p, d = turn.shape[-1], predicted.shape[-1]
    frame = np.zeros((len(turn), p + d, p + d))
    frame[:, :p, :p], frame[:, p:, p:] = turn, np.swapaxes(predicted, 1, 2)
    return frame
