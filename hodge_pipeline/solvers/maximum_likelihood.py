"""Maximum-likelihood poses of any graph, from any start: chordal rotations, then preconditioned Newton-CG."""

from __future__ import annotations

import math
import time
from dataclasses import fields, replace
from typing import Literal, TypeAlias

import numpy as np
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass as stage

from hodge_pipeline.complex.checks import NO_EDGES, check_fixed
from hodge_pipeline.complex.components import by_size, describe_components
from hodge_pipeline.complex.free_directions import free_direction_notes
from hodge_pipeline.errors import GraphError
from hodge_pipeline.one_blas_thread import one_blas_thread
from hodge_pipeline.solvers.certificate import Certificate, bounded, certify
from hodge_pipeline.solvers.escape import escape
from hodge_pipeline.solvers.minimise import Watch, at_start, metrics_of, minimise
from hodge_pipeline.solvers.newton import ROUNDING_REACHED, Descent, Limits, Point
from hodge_pipeline.solvers.priors import with_world, without_world
from hodge_pipeline.solvers.reweighted import reweighted
from hodge_pipeline.solvers.setup import InitialName, Setup, check_choice, held_rows, prepare
from hodge_pipeline.types import Floats, Ints, Priors, Solution, SolverIteration, ViewGraph
from hodge_pipeline.types.text import counted

ObjectiveName: TypeAlias = Literal["isotropic", "full"]
WILD_NUMBERS = "the edges' lengths or weights differ too much for more: look for a wrong edge or unit"
SEVERAL_FIXED = "not certified: with several fixed vertices to a component the dual is another one"


@one_blas_thread
def solve(
    graph: ViewGraph,
    *,
    start: Floats | None = None,
    objective: ObjectiveName = "full",
    initial: InitialName = "chordal",
    dimension: Literal[2, 3] | None = None,
    fixed: Ints | None = None,
    priors: Priors | None = None,
    certificate: bool = False,
    max_iterations: int = 100,
    relative_tolerance: float = 1e-9,
    time_limit_s: float = math.inf,
    keep_history: bool = False,
) -> Solution:
    """The poses of least cost, with `metrics["objective"]` their cost; `certified` where proven.

    - `objective`: `full` is Σ rᵀ Ω r with the 6x6 information of each edge (g2o's chi²); `isotropic` is
      Σ κ‖R_j − R_i R_ij‖² + τ‖t_j − t_i − R_i t_ij‖² (SE-Sync), the one that can be certified. A graph with an
      indefinite information matrix is solved as isotropic, and a note says so.
    - `start (V, 4, 4)` sets the gauge of each component; with `initial="given"` the descent begins there, else at
      the chordal rotations, which need no start.
    - `dimension`: 2 for a graph in the plane; None takes the graph's, and 2 where every edge lies in the plane.
    - `fixed`: rows of vertices that stay at their start; None takes the graph's.
    - `priors`: unary pose priors; all poses that have one share the world's gauge. None takes the graph's.

    With arrays in hand, in metres and radians, `i_from_j[e]` moving points of frame `edges[e, 1]` into `edges[e, 0]`:

        graph = ViewGraph.from_edges(np.arange(4), edges, i_from_j, information)
        world_from_cam = solve(graph).world_from_cam

    Raises `GraphError` for motions that are not finite and rigid, edges and fixed rows that name no vertex, and
    unknown options.
    """
    start = None if start is None else np.asarray(start, float)
    _check_options(graph, start, objective, initial, fixed, time_limit_s)
    whole, priors = graph, graph.priors if priors is None else priors
    if priors is not None and len(priors.vertices):
        (whole, start), fixed = with_world(graph, priors, start, fixed), None
    rows, unheld = held_rows(whole, start, fixed)
    setup = prepare(whole, start, rows, dimension, direct=certificate, full=objective == "full")
    full = objective == "full" and setup.weights.definite
    notes = [
        *unheld,
        *setup.weights.notes,
        *describe_components(by_size(setup.component[: graph.vertex_count]), graph.vertex_ids),
    ]
    if not setup.weights.used.any():
        notes.append(NO_EDGES)
    if objective == "full" and not full:
        notes.append("the full objective has no minimum with indefinite information: isotropic weights are used")
    history: list[SolverIteration] = []

    def watch(point: Point) -> None:
        if keep_history:
            history.append(SolverIteration(setup.poses(point), point.cost))

    limits = Limits(max_iterations, relative_tolerance, time.monotonic() + time_limit_s)
    descent = minimise(setup, initial, limits, full, watch)
    answer: Certificate | None = None
    if certificate and full:
        notes.append("only the isotropic objective can be certified")
    elif certificate:
        local = descent
        descent, answer = _certified(setup, local, limits, watch)
        if descent is not local:
            notes.append(f"a local minimum, F = {local.point.cost:.9g}, was escaped")
        notes.append(answer.note)
    metrics = metrics_of(descent, full)
    if start is not None:
        metrics["objective_at_start"] = at_start(setup, full).point.cost
    if answer is not None:
        metrics["gap_bound"] = answer.gap_bound
        metrics |= {} if answer.optimal else {"smallest_eigenvalue": answer.smallest_eigenvalue}
    if not descent.converged:
        why = f"{descent.reason} after {counted(len(descent.costs) - 1, 'step')}: these are the best poses so far"
        notes.append(f"{why}; {WILD_NUMBERS}" if descent.reason == ROUNDING_REACHED else why)
    solution = Solution(
        setup.poses(descent.point), setup.component, setup.weights.used.astype(float), tuple(history), metrics,
        tuple(notes), converged=descent.converged, stopped_by=descent.reason,
        certified=None if answer is None else answer.optimal,
    )  # fmt: skip
    return solution if whole is graph else without_world(solution, graph)


def _check_options(
    graph: ViewGraph, start: Floats | None, objective: str, initial: str, fixed: Ints | None, time_limit_s: float
) -> None:
    check_choice("objective", objective, ObjectiveName)
    check_choice("initial", initial, InitialName)
    if not time_limit_s > 0:
        raise GraphError(f"time_limit_s is {time_limit_s:g}: expected seconds above zero")
    check_fixed(graph.fixed if fixed is None else np.asarray(fixed), graph.vertex_count)
    if start is None and (initial == "given" or (fixed is not None and len(fixed))):
        raise GraphError("fixed vertices and a given initial guess need start poses: pass start")


def _certified(setup: Setup, descent: Descent, limits: Limits, watch: Watch) -> tuple[Descent, Certificate]:
    """The lowest isotropic minimum that the staircase finds from a descent's end, and its certificate; the same descent
    where its end is optimal, or nothing leads lower.
    """
    problem, point = setup.problem, descent.point
    if problem.count - problem.free_count > setup.component.max(initial=-1) + 1:
        return descent, Certificate(False, 0.0, math.inf, SEVERAL_FIXED)
    answer = certify(problem, point.rotations, point.translations, point.cost)
    if answer.optimal or answer.direction is None:
        return descent, answer
    found = escape(setup, point, answer, limits, watch)
    lowest = found.descent or descent
    return lowest, bounded(found.certificate, lowest.point.cost, found.bound)


@stage(frozen=True, config=ConfigDict(extra="forbid"))
class MaximumLikelihoodSolver:
    """Maximum-likelihood poses: the default solver."""

    objective: ObjectiveName = Field(
        "full",
        description="full: each edge's 6x6 information in its own frame (g2o's chi²), right for registered edges; "
        "isotropic: one weight for rotation and one for translation (SE-Sync), which can be certified",
    )
    initial: InitialName = Field(
        "chordal",
        description="chordal: rotations from a linear relaxation, whatever the start, so that drift cannot trap it; "
        "given: from the start, for warm calls where it is known to be good",
    )
    tails: Literal["gaussian", "student"] = Field(
        "gaussian",
        description="of the edges' errors: gaussian takes the information as stated; student, for edges that "
        "a run registered, weighs those by Student's t that leave over more than the others do",
    )
    certificate: bool = Field(False, description="test whether the isotropic minimum is the global one")
    max_iterations: int = Field(100, gt=0, description="Newton steps; real graphs need 3 to 12")
    relative_tolerance: float = Field(
        1e-9, gt=0, lt=1, description="share of the objective that further steps may still win when it stops"
    )
    time_limit_s: float = Field(math.inf, gt=0, description="seconds after which the best poses so far are given")

    def solve(self, graph: ViewGraph, world_from_cam: Floats) -> Solution:
        """The poses of least cost; the first vertex of each component keeps its start pose."""
        solution = self._solved(graph, world_from_cam, self.initial)
        free = free_direction_notes(graph)
        if self.tails == "gaussian" or not graph.edge_count:
            return replace(solution, notes=(*solution.notes, *free))

        def solved(weights: Floats, poses: Floats) -> Solution:
            weighted = replace(graph, information=weights[:, None, None] * graph.information)
            return self._solved(weighted, poses, "given")

        weights, final = reweighted(graph, solution.weights, solution, solved, registered=True)
        return replace(final, weights=weights, notes=(*final.notes, *free))

    def _solved(self, graph: ViewGraph, start: Floats, initial: InitialName) -> Solution:
        options = {one.name: getattr(self, one.name) for one in fields(self) if one.name not in ("initial", "tails")}
        return solve(graph, start=start, initial=initial, keep_history=True, **options)
