"""Newton steps by conjugate gradients with a multilevel preconditioner, which serves until it has grown too old."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import bsr_matrix

from hodge_pipeline.solvers.cg import CgResult, truncated_cg
from hodge_pipeline.solvers.multigrid import Modes, Preconditioner, Preconditioning
from hodge_pipeline.types import Floats

MOST_STEPS = 300
STALE_STEPS = 40
"""About what a new preconditioner costs: an old one that needs more is made anew."""
MOST_TURNED, SAMPLES = 0.05, 10_000
"""Of the levers' length, in a sample of the blocks: from there on an old preconditioner knows the wrong modes."""
LOOSEST = 0.1
"""Of a step's tolerance: the preconditioner reaches it in a few."""


@dataclass
class IterativeSolver:
    """Solves with one Hessian after another, and the latest preconditioner."""

    precondition: Preconditioning
    latest: Preconditioner | None = None
    levers: Floats | None = None
    tried: int = 0

    def steps_to_try(self, size: int) -> int:
        """None with another preconditioner."""
        return 0

    def solve(
        self, hessian: bsr_matrix, gradient: Floats, tolerance: float, enough: float, positions: Floats
    ) -> CgResult:
        """The step x with H x ≈ −g, H not indefinite, of poses at these positions (free, d)."""
        tolerance = min(tolerance, LOOSEST)
        if self.latest is None or self._turned(hessian, positions.shape[1]) > MOST_TURNED:
            return self._afresh(hessian, gradient, tolerance, positions)
        first = self._cg(self.latest, hessian, gradient, tolerance, STALE_STEPS)
        if first.steps < STALE_STEPS and not first.negative_curvature:
            return first
        left = float(np.linalg.norm(first.residual) / np.linalg.norm(gradient))
        then = self._afresh(hessian, first.residual, min(tolerance / left, 1.0), positions)
        return CgResult(first.x + then.x, then.residual, first.steps + then.steps)

    def refined(self, exact: bsr_matrix, gradient: Floats, tolerance: float) -> CgResult | None:
        """The step of another Hessian; None where the latest preconditioner does not serve it, or it is indefinite."""
        if self.latest is None:
            return None
        found = self._cg(self.latest, exact, gradient, min(tolerance, LOOSEST), STALE_STEPS)
        return None if found.negative_curvature or found.steps == STALE_STEPS else found

    def _afresh(self, hessian: bsr_matrix, gradient: Floats, tolerance: float, positions: Floats) -> CgResult:
        self.latest = None  # the old one's memory is better spent on the new one
        self.latest = self.precondition(hessian, Modes(positions))
        self.levers = _levers(hessian, positions.shape[1])
        return self._cg(self.latest, hessian, gradient, tolerance, MOST_STEPS)

    def _turned(self, hessian: bsr_matrix, dimension: int) -> float:
        """How far the levers have turned since the latest preconditioner was made, as a share of their length."""
        assert self.levers is not None
        change = np.linalg.norm(_levers(hessian, dimension) - self.levers)
        return float(change / max(np.linalg.norm(self.levers), 1e-300))

    @staticmethod
    def _cg(operator: Preconditioner, hessian: bsr_matrix, gradient: Floats, tolerance: float, most: int) -> CgResult:
        return truncated_cg(
            lambda x: np.asarray(hessian @ x), lambda r: operator(hessian, r), gradient, tolerance, most
        )


def _levers(hessian: bsr_matrix, dimension: int) -> Floats:
    """What couples rotations and translations in some blocks spread over the matrix."""
    some = hessian.data[:: max(len(hessian.data) // SAMPLES, 1)]
    return np.array(some[:, -dimension:, :-dimension])
