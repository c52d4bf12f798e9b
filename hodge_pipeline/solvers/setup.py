"""From a viewing graph's rows to a problem's order and back: gauge, pinned vertices, first guess."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal, TypeAlias, get_args

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.complex.checks import check_graph
from hodge_pipeline.complex.components import connected_components
from hodge_pipeline.errors import GraphError
from hodge_pipeline.solvers.chordal import initial_rotations
from hodge_pipeline.solvers.newton import Point
from hodge_pipeline.solvers.problem import Problem, make_problem, pinned_vertices
from hodge_pipeline.solvers.rotations import project
from hodge_pipeline.solvers.weights import Weights, dimension_of, edge_weights
from hodge_pipeline.types import Floats, Ints, ViewGraph

InitialName: TypeAlias = Literal["chordal", "given"]
DimensionName: TypeAlias = Literal[2, 3, None]
ROUNDING = 1e-22
"""Share of the objective at the worst residuals below which a cost is rounding."""
NO_ROWS = np.zeros(0, np.int64)


@dataclass(frozen=True)
class Setup:
    """A problem, and what takes its poses back to the graph's rows.

    - `weights`: of all edges of the graph; the problem holds those that are `used`, in their order.
    - `component (V,)` of the used edges; `gauge (V, 4, 4)`: what a solved pose is multiplied by on the left, since a
      component without a fixed vertex is solved with its first vertex at the identity.
    - `start (V, 4, 4)`: the given poses in the solver's gauge.
    """

    weights: Weights
    dimension: int
    component: Ints
    gauge: Floats
    start: Floats
    problem: Problem

    def poses(self, point: Point) -> Floats:
        """The poses (V, 4, 4) of a point in the graph's order and gauge."""
        d, order = self.dimension, self.problem.order
        poses = np.broadcast_to(np.eye(4), (len(order), 4, 4)).copy()
        poses[order, :d, :d], poses[order, :d, 3] = point.rotations, point.translations
        return np.asarray(self.gauge @ poses)

    def started(self, start: Floats) -> Setup:
        """The same with other start poses (V, 4, 4); the vertices that are held must lie where they did."""
        return replace(self, start=se3.inverse(self.gauge) @ start)

    def initial(self, name: InitialName) -> tuple[Floats, Floats]:
        """Rotations (n, d, d) and translations (n, d) in the problem's order to begin with."""
        d = self.dimension
        start = self.start[self.problem.order]
        translations = np.ascontiguousarray(start[:, :d, 3])
        if name == "given":
            return project(start[:, :d, :d]), translations
        pinned = project(start[self.problem.free_count :, :d, :d])
        return initial_rotations(self.problem, pinned), translations

    @property
    def rounding(self) -> float:
        """The cost that rounding alone leaves."""
        p = self.problem
        lengths = np.einsum("ei,ei->e", p.translations, p.translations)
        return float(ROUNDING * (p.dimension * p.kappa.sum() + p.tau @ lengths))


def prepare(
    graph: ViewGraph,
    start: Floats | None = None,
    fixed: Ints = NO_ROWS,
    dimension: DimensionName = None,
    direct: bool = False,
    full: bool = True,
) -> Setup:
    """The set-up of a graph; `direct`: a factorisation will be needed, whatever it costs; `full`: see `edge_weights`.

    Raises `GraphError` where its numbers cannot be used.
    """
    check_choice("dimension", dimension, DimensionName)
    check_graph(graph, start)
    size = dimension_of(graph) if dimension is None else dimension
    weights = edge_weights(graph, size, full)
    used = graph.edges[weights.used]
    component = connected_components(used, graph.vertex_count)
    gauge = _gauge(component, fixed, start)
    motion = graph.i_from_j[weights.used]
    problem = make_problem(
        used,
        project(motion[:, :size, :size]),
        np.ascontiguousarray(motion[:, :size, 3]),
        weights.kappa[weights.used],
        weights.tau[weights.used],
        pinned_vertices(component, fixed),
        direct,
    )
    return Setup(weights, size, component, gauge, gauge if start is None else se3.inverse(gauge) @ start, problem)


def held_rows(graph: ViewGraph, start: Floats | None, fixed: Ints | None = None) -> tuple[Ints, tuple[str, ...]]:
    """Rows of the vertices that stay at their start, `fixed` or the graph's; a note where these have no start."""
    if fixed is not None:
        return np.asarray(fixed, np.int64), ()
    if start is not None or not len(graph.fixed):
        return graph.fixed, ()
    count = len(graph.fixed)
    return NO_ROWS, (f"{count} fixed vertices have no pose: the first vertex of each piece is held instead",)


def _gauge(component: Ints, fixed: Ints, start: Floats | None) -> Floats:
    identity = np.broadcast_to(np.eye(4), (len(component), 4, 4))
    if start is None:
        return identity
    gauge: Floats = identity.copy()
    first = np.unique(component, return_index=True)[1]
    held = np.zeros(len(first), bool)
    held[component[fixed]] = True
    free = ~held[component]
    gauge[free] = start[first[component[free]]]
    return gauge


def check_choice(name: str, value: object, choices: Any) -> None:
    """Raises `GraphError` that lists the choices where the value is none of a `Literal` type's."""
    if value not in get_args(choices):
        raise GraphError(f"{name} {value!r} does not exist: take {' or '.join(map(repr, get_args(choices)))}")
