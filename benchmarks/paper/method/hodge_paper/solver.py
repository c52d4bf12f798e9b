"""The paper to the letter: embed the viewing graph, extend ω to the surface, solve the cotangent Poisson equation."""

from __future__ import annotations

import numpy as np
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from hodge_paper.minimum_cycles import shortest_loops
from hodge_paper.problem import PaperProblem, make_problem
from hodge_paper.surface import (
    MOST_CHECKED_EDGES,
    PaperSurface,
    RotationSystem,
    homology_metrics,
    make_surface,
)
from hodge_pipeline.complex.checks import NO_EDGES, check_graph, refuse_priors
from hodge_pipeline.complex.components import describe_components
from hodge_pipeline.complex.cycles import Loops, loop_deviation
from hodge_pipeline.complex.one_form import Logarithm
from hodge_pipeline.solvers.potential import (
    AroundLoops,
    deviation_metrics,
    iterate,
    unconverged_notes,
)
from hodge_pipeline.types import Floats, Solution, SolverIteration, ViewGraph


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class PaperSolver:
    """Poses whose 1-form on the embedding surface has no exact part left (paper, Section 4, step by step).

    1. `ω_ij`, the logarithm of the residual motion of each edge (Section 3.3; around the centroid of its component);
    2. Algorithm 1: a cyclic order of the edges at each vertex makes the graph a closed surface, cell by cell;
    3. the cells are cut into triangles, and Algorithm 2 gives each diagonal the integral of ω along a shortest path;
    4. the Poisson equation with cotangent weights (Eqs. (7)-(9)) gives f, and `T_k ← exp(f_k) T_k`.

    The surface is made once; every inner iteration forms ω anew and solves with the same factor. There are no robust
    weights and no information matrices: an edge is accepted before the solve, or it counts like any other. `poisson`
    solves the same equation on the graph alone; `docs/method.md` compares the two.
    """

    rotation: RotationSystem = Field(
        "random",
        description="the cyclic orders of Algorithm 1: random, the paper's, which makes few huge cells; angular, by "
        "the angle of the neighbours in each vertex's principal plane, which makes smaller cells and less genus",
    )
    seed: int = Field(0, ge=0, description="of the random orders; the same seed gives the same poses")
    log: Logarithm = Field(
        "pairing",
        description="logarithm of the residual motion: pairing is the paper's (rotation vector, translation), which "
        "depends on the edges' directions; se3 does not",
    )
    inner_iterations: int = Field(
        3, ge=1, description="Poisson steps with the same edges: each leaves about 2 % of the error (paper: 1 to 3)"
    )
    tolerance: float = Field(
        1e-10, gt=0, description="stop once the RMS of f over the vertices (radians and metres) is below this"
    )

    def solve(self, graph: ViewGraph, world_from_cam: Floats) -> Solution:
        """Consistent poses; a graph of several components is solved piece by piece, isolated vertices keep their pose.

        Fixed vertices have f = 0. Raises `GraphError` for motions that are not finite and rigid, for an empty graph,
        and for priors.
        """
        world_from_cam = np.asarray(world_from_cam, float)
        check_graph(graph, world_from_cam)
        refuse_priors(graph, "paper")
        problem = make_problem(graph, world_from_cam)
        weights = np.zeros(graph.edge_count)
        weights[problem.rows] = 1.0
        pieces = describe_components(problem.component, graph.vertex_ids)
        if not len(problem.edges):
            notes = (*problem.notes(), *pieces, NO_EDGES)
            return Solution(world_from_cam.copy(), problem.component, np.zeros(graph.edge_count), notes=notes)
        surface = make_surface(problem.edges, problem.start, self.rotation, self.seed)
        around_loops = shortest_loops(problem.edges, len(problem.component))
        generators = surface.generators() if surface.is_checked else None
        history = self._iterate(problem, surface, around_loops, generators)
        measured = loop_deviation(around_loops(problem.i_from_j))
        return Solution(
            world_from_cam=history[-1].world_from_cam,
            component=problem.component,
            weights=weights,
            history=history,
            metrics={
                "loops": float(len(measured)),
                **deviation_metrics(measured, "measured_loop_deviation"),
                "iterations": float(len(history)),
                **surface.sizes(),
                **(surface.shares(surface.form(problem.form(problem.start, self.log))) if surface.is_checked else {}),
                **homology_metrics(generators, problem.i_from_j, "measured_homology"),
                **history[-1].metrics,
            },
            notes=(*pieces, *self._notes(problem, surface, history)),
        )

    def _iterate(
        self, problem: PaperProblem, surface: PaperSurface, around_loops: AroundLoops, generators: Loops | None
    ) -> tuple[SolverIteration, ...]:
        solve_poisson = problem.poisson(surface.d0, surface.weights)
        return iterate(
            problem,
            self.log,
            lambda omega: solve_poisson(surface.form(omega)),
            surface.weights[: len(problem.edges)],
            around_loops,
            self.inner_iterations,
            self.tolerance,
            lambda adjusted: homology_metrics(generators, adjusted, "homology"),
        )

    def _notes(
        self, problem: PaperProblem, surface: PaperSurface, history: tuple[SolverIteration, ...]
    ) -> tuple[str, ...]:
        notes = [*problem.notes(), *problem.half_turn_notes(self.log)]
        if surface.is_checked:
            notes.extend(surface.connectivity_notes())
        else:
            notes.append(
                f"more than {MOST_CHECKED_EDGES} edges: energy shares, homology loops and connectivity are not computed"
            )
        return (*notes, *unconverged_notes(history))
