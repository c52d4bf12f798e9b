"""Preconditioned conjugate gradients for a Newton step: stops early, or at negative curvature."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from hodge_pipeline.types import Floats

Operator: TypeAlias = Callable[[Floats], Floats]


@dataclass(frozen=True)
class CgResult:
    """A descent direction x with H x ≈ −g, its residual H x + g, the steps taken, and why it may be short.

    `downhill`: the direction p of negative curvature, gᵀ p ≤ 0, at which it ended, where one was found.
    """

    x: Floats
    residual: Floats
    steps: int
    negative_curvature: bool = False
    downhill: Floats | None = None


def truncated_cg(
    apply: Operator,
    precondition: Operator,
    gradient: Floats,
    tolerance: float,
    max_steps: int,
    enough: float = 0.0,
) -> CgResult:
    """The Newton direction to within a tolerance, or up to the first direction of negative curvature (Steihaug 1983).

    `tolerance` is on the residual's norm in the preconditioner's metric, relative to that of g.
    It ends as at negative curvature where the preconditioner turns out not to be definite.
    It also ends where a step, times the steps so far, wins less than `enough` of xᵀ H x + 2 gᵀ x.
    """
    x, r = np.zeros_like(gradient), gradient.copy()
    z = precondition(r)
    rz = first = float(r @ z)
    direction = -z
    for step in range(1, max_steps + 1):
        if rz <= 0:
            return CgResult(x, r, step - 1, rz < 0)
        image = apply(direction)
        curvature = float(direction @ image)
        if curvature <= 0:
            if step == 1:
                return CgResult(direction, image + gradient, step, True, direction)
            return CgResult(x, r, step, True, direction)
        alpha = rz / curvature
        x += alpha * direction
        r += alpha * image
        z = precondition(r)
        new = float(r @ z)
        if new <= tolerance**2 * first or step * alpha * rz < enough:
            return CgResult(x, r, step)
        direction *= new / rz
        direction -= z
        rz = new
    return CgResult(x, r, max_steps)


def solved_columns(apply: Operator, precondition: Operator, rhs: Floats, tolerance: float, most_steps: int) -> Floats:
    """The solution x (n, k) of `apply(x) = rhs`, all columns as one system; `apply` and `precondition` take (n, k)."""
    found = truncated_cg(
        lambda x: apply(x.reshape(rhs.shape)).reshape(-1),
        lambda r: precondition(r.reshape(rhs.shape)).reshape(-1),
        -rhs.reshape(-1),
        tolerance,
        most_steps,
    )
    return found.x.reshape(rhs.shape)
