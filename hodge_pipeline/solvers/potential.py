"""What the Poisson solvers share: f of a 1-form, the poses moved by it, what is left of the edges' disagreement."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property, partial
from typing import TypeAlias

import numpy as np
from scipy.sparse import csr_matrix

from hodge_pipeline import se3
from hodge_pipeline.complex.coboundary import grounded_laplacian
from hodge_pipeline.complex.cycles import adjusted_edges, fundamental_products, loop_deviation, spanning_forest
from hodge_pipeline.complex.one_form import Logarithm, residual_form, shifted
from hodge_pipeline.solvers.linear import factorise
from hodge_pipeline.solvers.problem import pinned_vertices
from hodge_pipeline.types import Bools, Floats, Ints, SolverIteration
from hodge_pipeline.types.text import counted

STILL_MOVING = 1e-4
"""RMS of f: a step of 0.1 mm or 0.1 mrad is worth another iteration."""
AroundLoops: TypeAlias = Callable[[Floats], Floats]
"""The motions (L, 4, 4) around the loops of one cycle basis, from the motions (E, 4, 4) of the edges."""


@dataclass(frozen=True)
class CentredProblem:
    """The `edges (E, 2)` that can be used, and the `start (V, 4, 4)` poses around the centroid of their component.

    Far from the world's origin a little rotation would be much translation, and ω would depend on where the origin is.
    `offset (V, 3)`: the centroid of each pose's component; `fixed`: rows of the vertices that stay.
    """

    edges: Ints
    i_from_j: Floats
    component: Ints
    fixed: Ints
    start: Floats
    offset: Floats
    start_in_world: Floats

    @cached_property
    def held(self) -> Bools:
        """Vertices (V,) that end where they start: the fixed ones, and the first of each component without any."""
        return pinned_vertices(self.component, self.fixed)

    def form(self, poses: Floats, log: Logarithm) -> Floats:
        """ω (E, 6) at these poses."""
        return residual_form(self.edges, self.i_from_j, poses, log)

    def in_world(self, poses: Floats) -> Floats:
        """The poses away from the centroid again; held vertices are those of the start to the last bit."""
        out = shifted(poses, self.offset)
        out[self.held] = self.start_in_world[self.held]
        return out

    def moved(self, poses: Floats, correction: Floats, log: Logarithm) -> Floats:
        """`exp(f_k) T_k` (V, 4, 4), then each component without a fixed vertex as one body, so that its first vertex is
        at its start exactly, as the fixed vertices are.
        """
        motion = se3.pairing_exp(correction) if log == "pairing" else se3.exp(correction)
        out = motion @ poses
        first = np.unique(self.component, return_index=True)[1]
        body = np.asarray(self.start[first] @ se3.inverse(out[first]))
        body[self.component[self.fixed]] = np.eye(4)
        out = np.asarray(body[self.component] @ out)
        out[self.held] = self.start[self.held]
        return out

    def poisson(self, d0: csr_matrix, weights: Floats) -> Callable[[Floats], Floats]:
        """From ω (edges of d0, 6) to f (V, 6), `d0ᵀ W d0 f = d0ᵀ W ω` (Eq. (7)).

        f is 0 at the fixed vertices, and of mean zero on each component that has none. The Laplacian is factorised
        once; six right-hand sides are solved at a time.
        """
        factor = factorise(grounded_laplacian(d0, weights, self.held))
        count = np.bincount(self.component)[:, None].astype(float)
        count[self.component[self.fixed]] = np.inf

        def solve(omega: Floats) -> Floats:
            divergence = d0.T @ (weights[:, None] * omega)
            f = np.zeros_like(divergence)
            f[~self.held] = factor.solve(divergence[~self.held])
            sums = np.stack([np.bincount(self.component, column) for column in f.T], axis=1)
            return np.asarray(f - (sums / count)[self.component])

        return solve

    def half_turn_notes(self, log: Logarithm) -> tuple[str, ...]:
        """How many edges disagree with the start so much that their ω is ambiguous."""
        count = int((np.linalg.norm(self.form(self.start, log)[:, :3], axis=1) > np.pi - 1e-3).sum())
        if not count:
            return ()
        return (
            f"{counted(count, 'edge disagrees|edges disagree')} with the start by a half turn: the sign of "
            "their ω is arbitrary",
        )


def tree_loops(edges: Ints, vertex_count: int) -> AroundLoops:
    """The products around the loops of a breadth-first tree: D grows with their length, poses do not depend on it."""
    return partial(fundamental_products, spanning_forest(edges, vertex_count))


def iterate(
    problem: CentredProblem,
    log: Logarithm,
    correction_of: Callable[[Floats], Floats],
    weights: Floats,
    around_loops: AroundLoops,
    most: int,
    tolerance: float,
    more: Callable[[Floats], Mapping[str, float]] = lambda adjusted: {},
) -> tuple[SolverIteration, ...]:
    """Poisson steps from the start: ω (E, 6), f = `correction_of(ω)`, the poses moved by it; at `most` so many, until
    the RMS of f is below the tolerance. `more` metrics are of the adjusted edges (E, 4, 4).
    """
    poses, history = problem.start, []
    omega = problem.form(poses, log)
    for _ in range(most):
        correction = correction_of(omega)
        adjusted = adjusted_edges(problem.edges, poses, correction, pairing=log == "pairing")
        deviation = loop_deviation(around_loops(adjusted))
        poses = problem.moved(poses, correction, log)
        omega = problem.form(poses, log)
        step = float(np.sqrt((correction**2).sum(axis=1).mean()))
        metrics = {"step_rms": step, **deviation_metrics(deviation, "loop_deviation"), **more(adjusted)}
        objective = float(0.5 * weights @ (omega**2).sum(axis=1))
        history.append(SolverIteration(problem.in_world(poses), objective, metrics))
        if step < tolerance:
            break
    return tuple(history)


def deviation_metrics(deviation: Floats, name: str) -> Mapping[str, float]:
    """Sum and mean of the deviations (L,) of loops."""
    mean = float(deviation.mean()) if len(deviation) else 0.0
    return {f"{name}_sum": float(deviation.sum()), f"{name}_mean": mean}


def unconverged_notes(history: tuple[SolverIteration, ...]) -> tuple[str, ...]:
    """Whether the last step still moved the poses."""
    step = history[-1].metrics["step_rms"]
    if step <= STILL_MOVING:
        return ()
    return (f"not converged: step {len(history)} still moved the poses by {step:.2g}: more inner_iterations",)
