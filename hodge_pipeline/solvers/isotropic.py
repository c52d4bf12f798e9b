"""The isotropic objective F with rotations and translations moved together, by Gauss-Newton with a direct factor.

On graphs that are like long chains it takes the place of the descent in the rotations alone: there a lever moves a
translation so far that the scalar Laplacian is no preconditioner, and a factorisation of all unknowns is cheap.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.sparse import bsr_matrix, csr_matrix

from hodge_pipeline.solvers.cg import CgResult, solved_columns
from hodge_pipeline.solvers.direct import DirectSolver
from hodge_pipeline.solvers.iterative import IterativeSolver
from hodge_pipeline.solvers.multigrid import Modes, Preconditioner, Preconditioning
from hodge_pipeline.solvers.newton import Point, Step
from hodge_pipeline.solvers.objective import (
    IsotropicPoint,
    Residuals,
    curvature,
    gradient,
    residuals,
    translation_force,
)
from hodge_pipeline.solvers.problem import Problem
from hodge_pipeline.solvers.rotations import axial, lever
from hodge_pipeline.types import Floats

NEWTON_FROM = 0.05
"""Of the tolerance asked for, which says how far the minimum is: from there on the exact Hessian pays."""
CG_FIRST_TO = 15_000
"""Vertices: on longer chains CG takes too many steps to be worth a try."""
LONG_LEVER = 50.0
"""Of τ‖t_ij‖² / κ, most edges' at the least. What turns move at such levers' ends is more than the Laplacians know: on
the parking garage, with 75, CG takes 50 steps to solve a system, on graphs with less than 5 from 3 to 17.
"""

TOLERANCE, MOST_STEPS = 1e-3, 300
"""Of the translations that go with turned rotations: what is left is the next step's."""


@dataclass(frozen=True)
class TranslationSolver:
    """The translations that go with rotations: the Laplacian of τ with its preconditioner."""

    problem: Problem
    matrix: bsr_matrix
    precondition: Preconditioner

    @classmethod
    def of(cls, problem: Problem, precondition: Preconditioning) -> TranslationSolver:
        """The solver for a problem's τ."""
        matrix = problem.structure.laplacian(problem.tau).tobsr((1, 1))
        return cls(problem, matrix, precondition(matrix, Modes()))

    def matching(self, rotations: Floats, translations: Floats) -> Floats:
        """Translations (n, d) near those that minimise F for these rotations, from a guess; the pinned ones stay."""
        force = translation_force(self.problem, rotations, translations)
        csr = csr_matrix((self.matrix.data.reshape(-1), self.matrix.indices, self.matrix.indptr), self.matrix.shape)
        step = solved_columns(
            lambda x: np.asarray(csr @ x), lambda r: self.precondition(self.matrix, r), -force, TOLERANCE, MOST_STEPS
        )
        out: Floats = translations.copy()
        out[: self.problem.free_count] += step
        return out


def stiffness(kappa: Floats, turn: Floats) -> Floats:
    """Gauss-Newton's curvature (m, p, p) of κ‖R_j − R_i R_ij‖² = 2κ|r|², r = 2 sin(θ/2) n in the edge's own frame.

    In that frame a turn of the world changes no residual, so that the soft modes of long chains stay soft.
    """
    cosine = 0.25 * (np.einsum("eii->e", turn) + (1.0 if turn.shape[-1] == 3 else 2.0))
    if turn.shape[-1] == 2:
        return np.asarray((2 * kappa * cosine)[:, None, None])
    half = axial(turn) / (4 * np.sqrt(np.maximum(cosine, 1e-12)))[:, None]
    return np.asarray(2 * kappa[:, None, None] * (np.eye(3) - half[:, :, None] * half[:, None, :]))


def cg_first(problem: Problem) -> bool:
    """Whether CG with the two scalar Laplacians is worth a try where a factorisation of all unknowns is cheap."""
    squared = np.einsum("ei,ei->e", problem.translations, problem.translations)
    levered = int(np.count_nonzero(problem.tau * squared > LONG_LEVER * problem.kappa))
    return problem.free_count <= CG_FIRST_TO and levered <= 0.5 * len(squared)


def step_solver(problem: Problem) -> DirectSolver | IterativeSolver:
    """What solves for the steps of all unknowns, by the problem's back end."""
    structure = problem.structure
    return structure.iterative or DirectSolver(structure.elimination, cg_first(problem))


@dataclass(frozen=True)
class JointObjective:
    """F as a function of rotations and translations.

    With an iterative back end the translations follow every turn (`matching`): where soft modes bend a long graph, a
    straight step of theirs does not go far.
    """

    problem: Problem
    solver: DirectSolver | IterativeSolver
    matching: TranslationSolver | None = None

    @classmethod
    def of(cls, problem: Problem) -> JointObjective:
        """The objective of a problem."""
        precondition = problem.structure.precondition
        matching = None if precondition is None else TranslationSolver.of(problem, precondition)
        return cls(problem, step_solver(problem), matching)

    def at(self, rotations: Floats, translations: Floats) -> IsotropicPoint:
        """The point at these poses."""
        if self.matching is not None:
            translations = self.matching.matching(rotations, translations)
        left = residuals(self.problem, rotations, translations)
        return IsotropicPoint(rotations, translations, left.cost, left)

    def step(self, point: Point, tolerance: float, enough: float) -> Step:
        """A Gauss-Newton step."""
        assert isinstance(point, IsotropicPoint)
        slopes, near = gradient(self.problem, point.left).reshape(-1), tolerance < NEWTON_FROM
        if isinstance(self.solver, IterativeSolver):
            found = self._iterated(self.solver, point, slopes, tolerance, enough, near)
        else:
            positions = point.translations[: self.problem.free_count]
            found = self.solver.solve(self.normal_matrix(point.left), slopes, tolerance, enough, positions)
            exact = self.solver.refined(self.hessian(point.left), slopes, enough) if near else None
            found = exact if exact is not None else found
        slope = 2 * float(slopes @ found.x)
        return Step(found.x, slope, -0.5 * slope - float(found.x @ found.residual), found.steps)

    def moved(self, point: Point, direction: Floats) -> IsotropicPoint:
        """The point whose free poses are moved by a direction (free · (p + d),)."""
        return self.at(*self.problem.moved(point.rotations, point.translations, direction))

    def _iterated(
        self,
        solver: IterativeSolver,
        point: IsotropicPoint,
        slopes: Floats,
        tolerance: float,
        enough: float,
        near: bool,
    ) -> CgResult:
        """The step by the exact Hessian near a minimum, elsewhere or where it is not definite by Gauss-Newton's, which
        alone gives a preconditioner.
        """
        left, positions = point.left, point.translations[: self.problem.free_count]
        solver.look(self.problem.tau, left.shift + left.arm)
        if near and solver.latest is not None:
            found = solver.refined(self.hessian(left), slopes, tolerance)
            if found is not None:
                return found
        return solver.solve(self.normal_matrix(left), slopes, tolerance, enough, positions)

    def normal_matrix(self, left: Residuals) -> bsr_matrix:
        """Half the Gauss-Newton Hessian."""
        problem = self.problem
        reach = left.shift + left.arm

        def turned(edges: slice) -> Floats:
            own = stiffness(problem.kappa[edges], left.turn[edges])
            arm = lever(reach[edges])
            levered = problem.tau[edges, None, None] * (np.swapaxes(arm, 1, 2) @ arm)
            return np.stack([own + levered, own, -own, -own])

        return self._assembled(turned, reach)

    def hessian(self, left: Residuals) -> bsr_matrix:
        """Half the Hessian, the residuals' own curvature included: near a minimum it makes the steps Newton's."""
        return self._assembled(lambda edges: curvature(self.problem, left, edges), left.arm)

    def _assembled(self, turned: Callable[[slice], Floats], arm: Floats) -> bsr_matrix:
        """The matrix of blocks `turned` (4, m, p, p) of the rotations (ii, jj, ij, ji), and these levers."""
        problem, p = self.problem, self.problem.tangent_size
        size = p + problem.dimension

        def blocks(edges: slice) -> Floats:
            tau = problem.tau[edges, None, None]
            arms, weight = tau * lever(arm[edges]), tau * np.eye(problem.dimension)
            out = np.zeros((4, len(arms), size, size))
            out[:, :, :p, :p] = turned(edges)
            out[:2, :, p:, p:], out[2:, :, p:, p:] = weight, -weight
            out[0, :, p:, :p], out[3, :, p:, :p] = -arms, arms
            out[0, :, :p, p:], out[2, :, :p, p:] = np.swapaxes(-arms, 1, 2), np.swapaxes(arms, 1, 2)
            return out

        return problem.structure.symmetric_pattern.assemble(blocks, (size, size))
