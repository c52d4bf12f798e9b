"""Translations that follow the rotations, by conjugate gradients with a multilevel preconditioner."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import bsr_matrix, csr_matrix

from hodge_pipeline.solvers.cg import solved_columns
from hodge_pipeline.solvers.multigrid import Modes, Preconditioner, Preconditioning
from hodge_pipeline.solvers.objective import translation_force
from hodge_pipeline.solvers.problem import Problem
from hodge_pipeline.types import Floats

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
