"""Newton steps by a factorisation of all unknowns at once, which stays in use while it still preconditions well."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import bsr_matrix, diags_array

from hodge_pipeline.errors import GraphError
from hodge_pipeline.solvers.cg import CgResult, truncated_cg
from hodge_pipeline.solvers.elimination import Elimination
from hodge_pipeline.solvers.linear import Factor, factorise_blocks
from hodge_pipeline.types import Floats

FEWEST_CG_STEPS = 60
"""Where a factorisation of all unknowns costs no more, it is cheap."""
CG_STEPS_TRIED = 20
"""In all, at most, before a cheap factorisation is made: on small graphs they often suffice."""
STALE_STEPS = 8
"""CG steps with an old factor that cost about as much as a new one."""
FRESH_STEPS = 50
"""A guard: with the factor of its own Hessian a step of those graphs takes one, of one near by two."""
TOLERANCE = 1e-6
"""Of a step: looser ones leave the soft modes of long chains wrong. A factor in double precision needs one step."""
DAMPING = 1e-9
"""Of the diagonal: far above rounding, far below what slows the steps."""
NEARLY_THERE = 1e-2
"""Of the tolerance asked for, which says how far the minimum is: farther, an old factor leaves soft modes wrong."""
SECONDS_A_PRODUCT, SECONDS_A_VERTEX = 0.25e-9, 1e-7
SECONDS_A_FILL, SECONDS_A_MATVEC = 8e-9, 2e-7
"""Measured: of a factorisation with blocks of size s, times s³; of a CG step with the two scalar Laplacians."""


def factor_s(plan: Elimination, size: int) -> float:
    """Seconds of a factorisation with blocks of this size."""
    return SECONDS_A_PRODUCT * size**3 * plan.work + SECONDS_A_VERTEX * size**2 * plan.core


def laplacian_step_s(plan: Elimination) -> float:
    """Seconds of a CG step with the two scalar Laplacians."""
    return SECONDS_A_FILL * plan.fill + SECONDS_A_MATVEC * plan.size


def steps_worth_a_factor(plan: Elimination, size: int) -> int:
    """How many CG steps with the scalar Laplacians cost as much as a factorisation with blocks of this size."""
    step_s = laplacian_step_s(plan)
    return int(factor_s(plan, size) / step_s) if step_s > 0 else 0


@dataclass
class DirectSolver:
    """Solves with one Hessian after another, the latest factor, and how many CG steps went without one.

    `cg_first`: whether these are tried where a factorisation is cheap.
    """

    plan: Elimination
    cg_first: bool = True
    factor: Factor | None = None
    tried: int = 0

    def steps_to_try(self, size: int) -> int:
        """How many CG steps to try before a factorisation with blocks of this size."""
        worth = steps_worth_a_factor(self.plan, size)
        if self.factor is not None or (worth <= FEWEST_CG_STEPS and not self.cg_first):
            return 0
        return worth if worth > FEWEST_CG_STEPS else max(min(CG_STEPS_TRIED, worth) - self.tried, 0)

    def solve(
        self, hessian: bsr_matrix, gradient: Floats, tolerance: float, enough: float, positions: Floats
    ) -> CgResult:
        """The step x with H x ≈ −g: by CG with the factor of an earlier H where that is quick, else with its own.

        Where the poses are does not matter to a factor.
        """
        wasted = 0
        if self.factor is not None and tolerance < NEARLY_THERE:
            found = self._cg(hessian, gradient, TOLERANCE, enough, self.factor, STALE_STEPS)
            if found.steps < STALE_STEPS:
                return found
            wasted = found.steps
        self.factor = None
        self.factor = self._factor_of(hessian)
        found = self._cg(hessian, gradient, TOLERANCE, enough, self.factor, FRESH_STEPS)
        return CgResult(found.x, found.residual, wasted + found.steps)

    def _factor_of(self, hessian: bsr_matrix) -> Factor:
        """Its factor; that of a damped one where rounding has made it singular, as edges of wild lengths do."""
        try:
            return factorise_blocks(self.plan, hessian)
        except GraphError:
            damped = hessian + diags_array(DAMPING * hessian.diagonal())
            return factorise_blocks(self.plan, damped.tobsr(hessian.blocksize))

    def refined(self, exact: bsr_matrix, gradient: Floats, enough: float) -> CgResult | None:
        """The step of another Hessian, preconditioned by the latest factor; None where it is not definite."""
        assert self.factor is not None
        found = self._cg(exact, gradient, TOLERANCE, enough, self.factor, FRESH_STEPS)
        return None if found.negative_curvature else found

    @staticmethod
    def _cg(
        hessian: bsr_matrix, gradient: Floats, tolerance: float, enough: float, factor: Factor, most: int
    ) -> CgResult:
        return truncated_cg(lambda x: np.asarray(hessian @ x), factor.solve, gradient, tolerance, most, enough)
