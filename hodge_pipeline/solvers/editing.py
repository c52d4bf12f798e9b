"""Interactive editing of a pose graph: disable, restore, reweight or add edges, solve again, undo."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import breadth_first_order

from hodge_pipeline.complex.components import connected_components, describe_components
from hodge_pipeline.errors import GraphError
from hodge_pipeline.solvers.full_information import FullObjective
from hodge_pipeline.solvers.maximum_likelihood import ObjectiveName
from hodge_pipeline.solvers.minimise import at_start, descend_isotropic, full_objective, metrics_of, minimise
from hodge_pipeline.solvers.newton import Descent, Limits, descend, still_to_come
from hodge_pipeline.solvers.priors import PER_EDGE
from hodge_pipeline.solvers.problem import make_problem
from hodge_pipeline.solvers.setup import Setup, check_choice, held_rows, prepare
from hodge_pipeline.types import Floats, Ints, Solution, ViewGraph

LIMITS = Limits(max_iterations=100, relative_tolerance=1e-9)
"""Those of `solve`, as edits are to give its poses."""

SHARE = 10
"""Divides the number of free vertices: the most that a local solve moves."""
FEWEST = 500
"""Fewest vertices of a local solve: below, the whole graph is solved as fast."""
GROWTH, GROWTHS = 4, 2
"""Factor and number of growths of the neighbourhood, from the smallest on."""
LEAST_SHARE = 0.25
"""Least share of the gain of one growth that the next is expected to gain: influence decays slowly with distance."""


@dataclass(frozen=True)
class _State:
    """A state for `undo`: the edges, their weights relative to their information, the latest solution, and `owed`, by
    how much its objective may yet fall since poses far from the edits were not solved for.
    """

    graph: ViewGraph
    weights: Floats
    solution: Solution
    owed: float


@dataclass(frozen=True)
class _Base:
    """The set-up of some edges, which later solves with other weights start from."""

    graph: ViewGraph
    rows: Ints
    setup: Setup

    @property
    def used(self) -> Ints:
        """Rows of the graph's edges, in the problem's order."""
        return self.rows[self.setup.weights.used]


class GraphEditor:
    """A graph and its solution, kept together through edits.

        editor = GraphEditor(graph, solve(graph))
        editor.disable([17])
        better = editor.solve()
        editor.undo()

    Edges are named by their rows. A solve after an edit begins at the present poses, near the edges that changed, and
    ends there if those farther off have nothing to win. Where pieces part or join, or edges are new, the graph is set
    up again.

    The graph's fixed vertices stay where the solution has them; without a solution they have no such place, and a note
    says so.
    """

    def __init__(
        self, graph: ViewGraph, solution: Solution | None = None, *, objective: ObjectiveName = "full"
    ) -> None:
        check_choice("objective", objective, ObjectiveName)
        if graph.priors is not None and len(graph.priors.vertices):
            raise GraphError("priors cannot be edited yet: solve the graph with `solve`, or leave its priors out")
        if solution is not None and (
            solution.world_from_cam.shape != (graph.vertex_count, 4, 4) or len(solution.weights) != graph.edge_count
        ):
            raise GraphError("the solution is not of this graph: its poses or weights have another count")
        self._objective: ObjectiveName = objective
        self._history: list[_State] = []
        start = None if solution is None else solution.world_from_cam
        self._fixed, self._unheld = held_rows(graph, start)
        setup = self._prepared(graph, start)
        self._base = _Base(graph, np.arange(graph.edge_count), setup)
        if solution is None:
            solution = self._solution(self._base, minimise(setup, "chordal", LIMITS, self._full(setup)))
        own = "chi2" if self._full(setup) else "isotropic"
        settled = own in solution.metrics and solution.converged is True
        owed = 0.0 if settled else math.inf
        self._state = _State(graph, np.asarray(solution.weights, float).copy(), solution, owed)

    @property
    def graph(self) -> ViewGraph:
        """All edges, disabled ones too."""
        return self._state.graph

    @property
    def weights(self) -> Floats:
        """The weight (E,) of each edge relative to its information; 0: disabled."""
        return np.array(self._state.weights)

    @property
    def solution(self) -> Solution:
        """The latest solution: that of the edges as they were when it was made."""
        return self._state.solution

    def disable(self, rows: Sequence[int] | Ints) -> None:
        """Switch edges off."""
        self.reweight(rows, 0.0)

    def restore(self, rows: Sequence[int] | Ints) -> None:
        """Give edges their own information again."""
        self.reweight(rows, 1.0)

    def reweight(self, rows: Sequence[int] | Ints, weight: ArrayLike) -> None:
        """Let edges count as their information times a weight, one for all or one for each."""
        chosen = np.asarray(rows, np.int64).reshape(-1)
        wrong = (chosen < 0) | (chosen >= self.graph.edge_count)
        if wrong.any():
            raise GraphError(
                f"there is no edge {chosen[np.argmax(wrong)]}: rows go from 0 to {self.graph.edge_count - 1}"
            )
        values = np.asarray(weight, float)
        if not np.isfinite(values).all() or (values < 0).any():
            raise GraphError(f"edge weights must be finite and not negative, got {values.tolist()}")
        weights = self.weights
        weights[chosen] = values
        self._remember(replace(self._state, weights=weights))

    def add(self, edges: Ints, i_from_j: Floats, information: Floats | None = None) -> Ints:
        """The rows (K,) of new edges, between vertex rows (K, 2) of this graph."""
        old = self.graph
        added = ViewGraph.from_edges(old.vertex_ids, edges, i_from_j, information, "added")
        columns: dict[str, Any] = {
            name: np.concatenate([getattr(old, name), getattr(added, name)]) for name in PER_EDGE
        }
        graph = replace(old, **columns)
        weights = np.concatenate([self._state.weights, np.ones(added.edge_count)])
        self._remember(replace(self._state, graph=graph, weights=weights))
        return np.arange(old.edge_count, graph.edge_count)

    def undo(self) -> None:
        """Take back the last edit, and the solve after it. Raises `GraphError` where there is none."""
        if not self._history:
            raise GraphError("there is no edit to undo")
        self._state = self._history.pop()

    def solve(self, max_iterations: int = LIMITS.max_iterations) -> Solution:
        """The optimum of the edges as they are now; not converged after so many iterations, the next call goes on."""
        limits = replace(LIMITS, max_iterations=max_iterations)
        base = self._fitting_base()
        weights, scale = base.setup.weights, self._state.weights
        information = weights.information
        if self._objective == "full" and len(changed := np.flatnonzero(scale[base.rows] != 1)):
            information = information.copy()
            information[changed] *= scale[base.rows[changed], None, None]
        problem, own = base.setup.problem, scale[base.used]
        if (own != 1).any():
            problem = replace(problem, kappa=own * problem.kappa, tau=own * problem.tau)
        setup = replace(
            base.setup.started(self._state.solution.world_from_cam),
            problem=problem,
            weights=replace(weights, information=information),
        )
        full = self._full(setup)
        before = np.zeros_like(scale)
        before[: len(self._state.solution.weights)] = self._state.solution.weights
        changed = scale != before
        moved = np.flatnonzero(changed[base.used])
        everywhere = len(moved) < np.count_nonzero(changed)
        near, to_come = (setup, math.inf) if everywhere else settled_nearby(setup, moved, limits, full)
        owed = self._state.owed + to_come
        descent = at_start(near, full)
        if owed > LIMITS.relative_tolerance * descent.point.cost:
            descent = minimise(near, "given", limits, full)
            owed = 0.0 if descent.converged else math.inf
        used = np.zeros(self.graph.edge_count)
        used[base.used] = scale[base.used]
        solution = replace(self._solution(base, descent), weights=used)
        self._state = replace(self._state, solution=solution, owed=owed)
        return solution

    def _prepared(self, graph: ViewGraph, start: Floats | None) -> Setup:
        return prepare(graph, start, self._fixed, full=self._objective == "full")

    def _full(self, setup: Setup) -> bool:
        return self._objective == "full" and setup.weights.definite

    def _solution(self, base: _Base, descent: Descent) -> Solution:
        setup = base.setup
        notes = (*self._unheld, *setup.weights.notes, *describe_components(setup.component, base.graph.vertex_ids))
        weights = setup.weights.used.astype(float)
        metrics = metrics_of(descent, self._full(setup))
        return Solution(
            setup.poses(descent.point), setup.component, weights, metrics=metrics, notes=notes,
            converged=descent.converged, stopped_by=descent.reason,
        )  # fmt: skip

    def _remember(self, new: _State) -> None:
        self._history.append(self._state)
        self._state = new

    def _fitting_base(self) -> _Base:
        """The set-up that the present weights are a change of; made anew where the one at hand is not."""
        if self._base.graph is not self.graph or not self._fits(self._base):
            everything = self._make_base(np.arange(self.graph.edge_count))
            fits = self._fits(everything)
            self._base = everything if fits else self._make_base(np.flatnonzero(self._state.weights > 0))
        return self._base

    def _fits(self, base: _Base) -> bool:
        """Whether its edges hold all that count now, and fall into the same pieces."""
        counted = self._state.weights > 0
        left_out = counted.copy()
        left_out[base.rows] = False
        holding = ~base.setup.weights.partly[base.setup.weights.used]
        joining = base.used[counted[base.used] & holding]
        component = connected_components(self.graph.edges[joining], self.graph.vertex_count)
        return not left_out.any() and bool(np.array_equal(component, base.setup.component))

    def _make_base(self, rows: Ints) -> _Base:
        start = self._state.solution.world_from_cam
        return _Base(self.graph, rows, self._prepared(self.graph.select(rows), start))


def settled_nearby(setup: Setup, changed: Ints, limits: Limits, full: bool) -> tuple[Setup, float]:
    """The set-up with start poses optimised near the changed edges (rows of the problem), and by how much the objective
    may still fall farther off, extrapolated from the gains of growing neighbourhoods.
    """
    most = setup.problem.free_count // SHARE
    if not len(changed):
        return setup, 0.0
    if most < FEWEST:
        return setup, math.inf
    nearest, poses, won = _nearest(setup, changed, most), setup.initial("given"), [0.0]
    for growth in range(GROWTHS, -1, -1):
        end = _settled(setup, nearest[: most // GROWTH**growth], poses, limits, full)
        won.append(end.costs[0] - end.costs[-1])
    return _with_start(setup, *poses), still_to_come(won[-1], won[-2], LEAST_SHARE)


def _settled(setup: Setup, moving: Ints, poses: tuple[Floats, Floats], limits: Limits, full: bool) -> Descent:
    """The descent of the poses of the `moving` vertices alone, which are overwritten in `poses`."""
    problem, (rotations, translations) = setup.problem, poses
    inside = np.zeros(problem.count, bool)
    inside[moving] = True
    inside[problem.free_count :] = False
    edges = np.flatnonzero((inside[problem.tail] | inside[problem.head]) & (problem.kappa > 0))
    vertices, ends = np.unique(np.stack([problem.tail[edges], problem.head[edges]]), return_inverse=True)
    local = make_problem(
        ends.reshape(2, -1).T,
        problem.rotations[edges],
        problem.translations[edges],
        problem.kappa[edges],
        problem.tau[edges],
        ~inside[vertices],
    )
    places = vertices[local.order]
    begin = rotations[places], translations[places]
    if full:
        objective = FullObjective.of(local, full_objective(setup).information[edges])
        found = descend(objective, objective.at(*begin), limits, setup.rounding)
    else:
        found = descend_isotropic(local, begin, limits, setup.rounding)
    rotations[places], translations[places] = found.point.rotations, found.point.translations
    return found


def _nearest(setup: Setup, changed: Ints, most: int) -> Ints:
    """The first vertices that a breadth-first search from the ends of the changed edges reaches."""
    problem = setup.problem
    ends = np.unique(np.concatenate([problem.tail[changed], problem.head[changed]]))
    root = problem.count
    tail = np.concatenate([problem.tail, np.full(len(ends), root)])
    head = np.concatenate([problem.head, ends])
    ones = np.ones(len(tail), np.int32)
    adjacency = csr_matrix((ones, (tail, head)), shape=(root + 1, root + 1))
    found = breadth_first_order(adjacency, root, directed=False, return_predecessors=False)
    return np.asarray(found[1 : most + 1], np.int64)


def _with_start(setup: Setup, rotations: Floats, translations: Floats) -> Setup:
    start, d, order = setup.start.copy(), setup.dimension, setup.problem.order
    start[order, :d, :d], start[order, :d, 3] = rotations, translations
    return replace(setup, start=start)
