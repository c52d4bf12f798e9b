"""Newton steps by conjugate gradients with a multilevel preconditioner, which serves until it has grown too old."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import bsr_matrix

from hodge_pipeline.solvers.cg import CgResult, truncated_cg
from hodge_pipeline.solvers.multigrid import Modes, Preconditioner, Preconditioning
from hodge_pipeline.types import Floats

MOST_STEPS = 300
"""A guard: ten times what an old preconditioner is given."""
STALE_STEPS = 30
"""About what a new preconditioner costs: an old one that needs more is made anew."""
MOST_TURNED, SAMPLES = 0.05, 10_000
"""Of the levers' length, in a sample of the edges: from there on an old preconditioner knows the wrong modes."""
LOOSEST = 1e-3
"""Of a step's tolerance: a new preconditioner reaches it in a few."""


@dataclass
class IterativeSolver:
    """Solves with one Hessian after another, and the latest preconditioner, with the levers that it was made for."""

    precondition: Preconditioning
    latest: Preconditioner | None = None
    levers: Floats | None = None
    seen: Floats | None = None
    tried: int = 0

    def look(self, weights: Floats, levers: Floats) -> None:
        """Take note of the edges' levers (E, d), to be called before a step's matrix is made: a preconditioner that
        they have turned away from is let go, memory and all.
        """
        some = slice(None, None, max(len(levers) // SAMPLES, 1))
        self.seen = weights[some, None] * levers[some]
        if self.latest is not None and self.levers is not None:
            change = np.linalg.norm(self.seen - self.levers)
            if change > MOST_TURNED * np.linalg.norm(self.levers):
                self.latest = None

    def steps_to_try(self, size: int) -> int:
        """None with another preconditioner."""
        return 0

    def solve(
        self, hessian: bsr_matrix, gradient: Floats, tolerance: float, enough: float, positions: Floats
    ) -> CgResult:
        """The step x with H x ≈ −g, H not indefinite, of poses at these positions (free, d)."""
        tolerance = min(tolerance, LOOSEST)
        if self.latest is None:
            return self._afresh(hessian, gradient, tolerance, positions)
        first = self._cg(self.latest, hessian, gradient, tolerance, STALE_STEPS)
        if first.steps < STALE_STEPS and not first.negative_curvature:
            return first
        left = float(np.linalg.norm(first.residual) / np.linalg.norm(gradient))
        then = self._afresh(hessian, first.residual, min(tolerance / left, 1.0), positions)
        return CgResult(first.x + then.x, then.residual, first.steps + then.steps)

    def refined(self, exact: bsr_matrix, gradient: Floats, tolerance: float) -> CgResult | None:
        """The step of another Hessian; None where that is indefinite, or the latest preconditioner does not serve it:
        one that is too old is let go.
        """
        if self.latest is None:
            return None
        found = self._cg(self.latest, exact, gradient, min(tolerance, LOOSEST), STALE_STEPS)
        if found.steps == STALE_STEPS:
            self.latest = None
        return None if found.negative_curvature or self.latest is None else found

    def _afresh(self, hessian: bsr_matrix, gradient: Floats, tolerance: float, positions: Floats) -> CgResult:
        self.latest = None  # the old one's memory is better spent on the new one
        self.latest = self.precondition(hessian, Modes(positions))
        self.levers = self.seen
        return self._cg(self.latest, hessian, gradient, tolerance, MOST_STEPS)

    @staticmethod
    def _cg(operator: Preconditioner, hessian: bsr_matrix, gradient: Floats, tolerance: float, most: int) -> CgResult:
        return truncated_cg(
            lambda x: np.asarray(hessian @ x), lambda r: operator(hessian, r), gradient, tolerance, most
        )
