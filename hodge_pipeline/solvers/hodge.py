"""Maximum-likelihood poses of any graph, from any start: chordal rotations, then Newton-CG preconditioned by Laplacians."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass as stage

from hodge_pipeline import se3
from hodge_pipeline.complex.components import connected_components, describe_components
from hodge_pipeline.errors import GraphError
from hodge_pipeline.solvers.certificate import Certificate, certify
from hodge_pipeline.solvers.chordal import chordal_rotations
from hodge_pipeline.solvers.full import FullObjective
from hodge_pipeline.solvers.newton import Descent, Limits, Point, descend
from hodge_pipeline.solvers.objective import IsotropicObjective
from hodge_pipeline.solvers.problem import make_problem, pinned_vertices
from hodge_pipeline.solvers.rotations import project
from hodge_pipeline.solvers.weights import Weights, check_graph, edge_weights, is_planar
from hodge_pipeline.types import Floats, Ints, Solution, SolverIteration, ViewGraph

ObjectiveName = Literal["isotropic", "full"]
InitialName = Literal["chordal", "given"]
WARM_START_TOLERANCE = 1e-4
"""The isotropic optimum starts the full objective: nearer than this they differ anyway."""
ROUNDING = 1e-22


def solve(
    graph: ViewGraph,
    *,
    start: Floats | None = None,
    objective: ObjectiveName = "full",
    initial: InitialName = "chordal",
    dimension: Literal[2, 3] | None = None,
    fixed: Ints | None = None,
    certificate: bool = False,
    max_iterations: int = 100,
    relative_tolerance: float = 1e-10,
    time_limit_s: float = math.inf,
    keep_history: bool = False,
) -> Solution:
    """The poses of least cost, with `metrics["objective"]` their cost and `metrics["certified"]` 1 where proven.

    - `objective`: `full` is Σ rᵀ Ω r with the 6x6 information of each edge (g2o's chi²); `isotropic` is
      Σ κ‖R_j − R_i R_ij‖² + τ‖t_j − t_i − R_i t_ij‖² (SE-Sync), the one that can be certified. A graph with an
      indefinite information matrix is solved as isotropic, and a note says so.
    - `start (V, 4, 4)` sets the gauge of each component; with `initial="given"` the descent begins there, else at
      the chordal rotations, which need no start.
    - `dimension`: 2 for a graph in the plane; None finds out.
    - `fixed`: rows of vertices that stay at their start.

    Raises `GraphError` for numbers that are not finite and edges that name no vertex.
    """
    check_graph(graph)
    options = _Options(objective, initial, certificate, max_iterations, relative_tolerance, time_limit_s, keep_history)
    rows = np.zeros(0, np.int64) if fixed is None else np.asarray(fixed, np.int64)
    if start is None and (initial == "given" or len(rows)):
        raise GraphError("fixed vertices and a given initial guess need start poses: pass start")
    size = (2 if is_planar(graph) else 3) if dimension is None else dimension
    return _Run(graph, edge_weights(graph, size), size, rows, start, options).solve()


@dataclass(frozen=True)
class _Options:
    objective: ObjectiveName
    initial: InitialName
    certificate: bool
    max_iterations: int
    relative_tolerance: float
    time_limit_s: float
    keep_history: bool


class _Run:
    """One solve: from the graph's rows to the problem's order and back."""

    def __init__(
        self, graph: ViewGraph, weights: Weights, dimension: int, fixed: Ints, start: Floats | None, options: _Options
    ) -> None:
        self.graph, self.weights, self.dimension, self.options = graph, weights, dimension, options
        self.deadline_s = time.monotonic() + options.time_limit_s
        used = graph.edges[weights.used]
        self.component = connected_components(used, graph.vertex_count)
        self.pinned = pinned_vertices(self.component, fixed)
        self.gauge = self._gauge(fixed, start)
        poses = np.broadcast_to(np.eye(4), (graph.vertex_count, 4, 4)) if start is None else start
        self.start = se3.inverse(self.gauge) @ poses
        d, motion = dimension, graph.i_from_j[weights.used]
        self.problem = make_problem(
            used,
            project(motion[:, :d, :d]),
            np.ascontiguousarray(motion[:, :d, 3]),
            weights.kappa[weights.used],
            weights.tau[weights.used],
            self.pinned,
        )
        self.history: list[SolverIteration] = []

    def _gauge(self, fixed: Ints, start: Floats | None) -> Floats:
        """What each vertex's solved pose is multiplied by on the left (V, 4, 4): components without a fixed vertex
        are solved with their first vertex at the identity.
        """
        gauge = np.broadcast_to(np.eye(4), (self.graph.vertex_count, 4, 4)).copy()
        if start is None:
            return gauge
        first = np.unique(self.component, return_index=True)[1]
        held = np.isin(np.arange(len(first)), self.component[fixed])
        free = ~held[self.component]
        gauge[free] = start[first[self.component[free]]]
        return gauge

    def solve(self) -> Solution:
        """The solution, by the isotropic objective first."""
        options, problem, notes = self.options, self.problem, list(self.weights.notes)
        notes += describe_components(self.component, self.graph.vertex_ids)
        full = options.objective == "full" and self.weights.definite
        if options.objective == "full" and not full:
            notes.append("the full objective has no minimum with indefinite information: isotropic weights are used")
        isotropic = IsotropicObjective(problem)
        tolerance = max(options.relative_tolerance, WARM_START_TOLERANCE) if full else options.relative_tolerance
        limits = Limits(options.max_iterations, tolerance, self.deadline_s)
        descent = descend(isotropic, isotropic.at(*self._initial()), limits, self._floor(), self._watch("isotropic"))
        if full:
            descent = self._full(descent, limits)
        if not descent.converged:
            notes.append(f"{descent.reason} after {len(descent.costs) - 1} steps: these are the best poses so far")
        metrics = self._metrics(descent, full)
        if options.certificate and not full:
            answer = self._certify(descent.point)
            notes.append(answer.note)
            metrics |= {"certified": float(answer.optimal), "gap_bound": answer.gap_bound}
        elif options.certificate:
            notes.append("only the isotropic objective can be certified")
        poses = self._poses(descent.point)
        weights = np.zeros(self.graph.edge_count)
        weights[self.weights.used] = 1.0
        return Solution(poses, self.component, weights, tuple(self.history), metrics, tuple(notes))

    def _full(self, warm: Descent, limits: Limits) -> Descent:
        options = self.options
        objective = FullObjective(self.problem, self.weights.information[self.weights.used])
        left = replace(limits.after(len(warm.costs) - 1), relative_tolerance=options.relative_tolerance)
        point = objective.at(warm.point.rotations, warm.point.translations)
        descent = descend(objective, point, left, self._floor(), self._watch("full"))
        return replace(descent, cg_steps=descent.cg_steps + warm.cg_steps)

    def _certify(self, point: Point) -> Certificate:
        if self.pinned.sum() > self.component.max(initial=-1) + 1:
            note = "not certified: a graph with several fixed vertices has another dual"
            return Certificate(False, 0.0, math.inf, 0, note)
        return certify(self.problem, point.rotations, point.translations, point.cost)

    def _initial(self) -> tuple[Floats, Floats]:
        d, order = self.dimension, self.problem.order
        start = self.start[order]
        translations = np.ascontiguousarray(start[:, :d, 3])
        if self.options.initial == "given":
            return project(start[:, :d, :d]), translations
        pinned = project(start[self.problem.free_count :, :d, :d])
        return chordal_rotations(self.problem, pinned), translations

    def _floor(self) -> float:
        """The cost that rounding alone leaves."""
        problem = self.problem
        scale = problem.kappa.sum() * problem.dimension
        return float(
            ROUNDING * (scale + problem.tau @ np.einsum("ei,ei->e", problem.translations, problem.translations))
        )

    def _poses(self, point: Point) -> Floats:
        d, order = self.dimension, self.problem.order
        poses = np.broadcast_to(np.eye(4), (len(order), 4, 4)).copy()
        poses[order, :d, :d], poses[order, :d, 3] = point.rotations, point.translations
        return self.gauge @ poses

    def _watch(self, name: str):  # type: ignore[no-untyped-def]
        if not self.options.keep_history:
            return None
        return lambda point: self.history.append(SolverIteration(self._poses(point), point.cost, {name: point.cost}))

    def _metrics(self, descent: Descent, full: bool) -> dict[str, float]:
        name = "chi2" if full else "isotropic"
        return {
            "objective": descent.point.cost,
            name: descent.point.cost,
            "iterations": float(len(descent.costs) - 1),
            "cg_steps": float(descent.cg_steps),
            "converged": float(descent.converged),
        }


@stage(frozen=True, config=ConfigDict(extra="forbid"))
class HodgeSolver:
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
    certificate: bool = Field(False, description="test whether the isotropic minimum is the global one")
    max_iterations: int = Field(100, gt=0, description="Newton steps; real graphs need 3 to 12")
    relative_tolerance: float = Field(
        1e-10, gt=0, lt=1, description="share of the objective that further steps may still win when it stops"
    )
    time_limit_s: float = Field(math.inf, gt=0, description="seconds after which the best poses so far are given")

    def solve(self, graph: ViewGraph, world_from_cam: Floats) -> Solution:
        """The poses of least cost; the first vertex of each component keeps its start pose."""
        return solve(
            graph,
            start=world_from_cam,
            objective=self.objective,
            initial=self.initial,
            certificate=self.certificate,
            max_iterations=self.max_iterations,
            relative_tolerance=self.relative_tolerance,
            time_limit_s=self.time_limit_s,
            keep_history=True,
        )
