"""The plain Poisson solver: the exact part of the residual 1-form moves the poses (paper, Section 4, Eqs. (7)-(9))."""

from __future__ import annotations

import numpy as np
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from hodge_pipeline.complex.checks import NO_EDGES, check_graph, orthonormal, refuse_priors
from hodge_pipeline.complex.coboundary import coboundary_0
from hodge_pipeline.complex.components import connected_components, describe_components
from hodge_pipeline.complex.cycles import loop_deviation
from hodge_pipeline.complex.one_form import Logarithm, centroids, shifted
from hodge_pipeline.solvers.potential import (
    AroundLoops,
    CentredProblem,
    deviation_metrics,
    iterate,
    tree_loops,
    unconverged_notes,
)
from hodge_pipeline.types import Bools, Floats, Solution, SolverIteration, ViewGraph
from hodge_pipeline.types.text import counted


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class PoissonSolver:
    """Poses whose residual 1-form has no exact part left: `L f = d0ᵀ W ω`, `T_k ← exp(f_k) T_k`, a few times.

    Every step is one scalar sparse factorisation with six right-hand sides. ω is formed around the centroid of each
    connected component: far from the world's origin a little rotation would become much translation, and the result
    would depend on where the origin is. f is taken with mean zero, then the component is moved back as one body, so
    that its first vertex keeps its pose exactly. Fixed vertices have f = 0, and a component with one is not moved back.

    Every edge weighs 1, as in the paper up to a factor, whatever its information: a run leaves out what its diagnosis
    calls wrong before the solve (`solve_with`). The deviation D in the history measures the *adjusted* edges
    `T_i⁻¹ exp(f_j − f_i) T_j` of that one step, that is how far the exponential of the sum is from the product of
    exponentials. It is never taken from the absolute poses, where it is 0 by construction, and says nothing about the
    measured edges' own inconsistency, which no solver can change (`measured_loop_deviation_*` in the metrics).
    """

    inner_iterations: int = Field(
        default=3,
        ge=1,
        description="Poisson steps with the same edges: each leaves about 2 % of the error (paper: 1 to 3)",
    )
    tolerance: float = Field(
        default=1e-10, gt=0, description="stop once the RMS of f over the vertices (radians and metres) is below this"
    )
    log: Logarithm = Field(
        default="se3",
        description="logarithm of the residual motion: se3 does not depend on the edges' directions; pairing is the "
        "paper's own (rotation vector, translation), which does",
    )

    def solve(self, graph: ViewGraph, world_from_cam: Floats) -> Solution:
        """Consistent poses; a graph of several components is solved piece by piece, isolated vertices keep their pose.

        Raises `GraphError` for motions that are not finite and rigid, for an empty graph, and for priors.
        """
        world_from_cam = np.asarray(world_from_cam, float)
        check_graph(graph, world_from_cam)
        refuse_priors(graph, "poisson")
        used = graph.edges[:, 0] != graph.edges[:, 1]
        problem = _problem(graph, used, world_from_cam)
        around_loops = tree_loops(problem.edges, len(problem.component))
        history = self._iterate(problem, around_loops)
        measured = loop_deviation(around_loops(problem.i_from_j))
        metrics = {
            "loops": float(len(measured)),
            **deviation_metrics(measured, "measured_loop_deviation"),
            "iterations": float(len(history)),
            **(history[-1].metrics if history else {}),
        }
        return Solution(
            world_from_cam=history[-1].world_from_cam if history else world_from_cam.copy(),
            component=problem.component,
            weights=used.astype(float),
            history=history,
            metrics=metrics,
            notes=(
                *_edge_notes(used),
                *describe_components(problem.component, graph.vertex_ids),
                *self._convergence_notes(problem, history),
            ),
        )

    def _iterate(self, problem: CentredProblem, around_loops: AroundLoops) -> tuple[SolverIteration, ...]:
        if len(problem.edges) == 0:
            return ()
        ones = np.ones(len(problem.edges))
        potential = problem.poisson(coboundary_0(problem.edges, len(problem.component)), ones)
        return iterate(problem, self.log, potential, ones, around_loops, self.inner_iterations, self.tolerance)

    def _convergence_notes(self, problem: CentredProblem, history: tuple[SolverIteration, ...]) -> tuple[str, ...]:
        if not history:
            return (NO_EDGES,)
        return (*problem.half_turn_notes(self.log), *unconverged_notes(history))


def _problem(graph: ViewGraph, used: Bools, world_from_cam: Floats) -> CentredProblem:
    edges = graph.edges[used]
    component = connected_components(edges, graph.vertex_count)
    offset = centroids(world_from_cam, component)
    return CentredProblem(
        edges=edges,
        i_from_j=orthonormal(graph.i_from_j[used]),
        component=component,
        fixed=graph.fixed,
        start=orthonormal(shifted(world_from_cam, -offset)),
        offset=offset,
        start_in_world=world_from_cam,
    )


def _edge_notes(used: Bools) -> tuple[str, ...]:
    if used.all():
        return ()
    told = counted(int((~used).sum()), "edge joins|edges join")
    return (f"{told} a vertex to itself, without information on poses: ignored",)
