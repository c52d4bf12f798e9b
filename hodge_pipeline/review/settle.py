"""Poses after each decision: the graph with the weights that decisions give its edges, solved from the last poses."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.diagnosis.diagnosis import diagnose
from hodge_pipeline.diagnosis.options import DiagnosisOptions
from hodge_pipeline.diagnosis.result import Diagnosis
from hodge_pipeline.errors import GraphError
from hodge_pipeline.evaluation.residuals import edge_residuals
from hodge_pipeline.evaluation.trajectory import absolute_error, align
from hodge_pipeline.pairs.edits import ENABLED, REGISTERED, RIGHT, History, pair_names
from hodge_pipeline.review.subject import Subject, base_weights, let_in
from hodge_pipeline.rounds.by_hand import BY_HAND
from hodge_pipeline.solvers.editing import GraphEditor
from hodge_pipeline.solvers.maximum_likelihood import solve
from hodge_pipeline.types import Bools, Edges, Floats, Ints, Registration, Solution, ViewGraph
from hodge_pipeline.types.arrays import Words
from hodge_pipeline.types.edges import DISABLED, REJECTED, USED

MOST_CHECKED = 20_000
"""Edges up to which a solve is checked by one from the edges alone, about 0.05 CPU seconds for each 1000."""
PREVIEW_STEPS = 8
"""Newton steps after which poses are shown, converged or not: a change that stays near the minimum takes 2 to 6."""
LOWER = 1e-6
"""Share by which a cost must be lower to be another minimum's."""


@dataclass(frozen=True)
class Settled:
    """Poses (V, 4, 4) at a revision of the decisions, with the weights and residuals (E,) of the edges.

    `moved_m`: the farthest that the latest decision moved a pose; `error_m`: the RMS error where the truth is known.
    """

    revision: int
    world_from_cam: Floats
    component: Ints
    weights: Floats
    residual_m: Floats
    residual_rad: Floats
    seconds: float
    moved_m: float
    error_m: float | None
    converged: bool


@dataclass(frozen=True)
class Judged:
    """All edges with their verdicts, and the diagnosis of those `rows` of them that were judged, ascending."""

    edges: Edges
    diagnosis: Diagnosis
    rows: Ints

    def row(self, edge: int) -> int | None:
        """The row of an edge in the diagnosis; None where it was not judged."""
        at = int(np.searchsorted(self.rows, edge))
        return at if at < len(self.rows) and self.rows[at] == edge else None


@dataclass(frozen=True)
class Table:
    """All edges and their graph, row by row.

    `base (E,)`: weights without a decision; `let_in (E,)`: whether enabling gives an edge weight; `added (E,)`: whether
    it was added in this review; `rows`: those of each pair `a-b`, named in both directions.
    """

    edges: Edges
    graph: ViewGraph
    base: Floats
    let_in: Bools
    added: Bools
    rows: dict[str, list[int]]

    @classmethod
    def of(cls, subject: Subject) -> Table:
        """The edges of a subject."""
        none = np.zeros(len(subject.edges), bool)
        return cls(subject.edges, subject.graph, base_weights(subject), let_in(subject), none, _rows(subject.graph))

    def __len__(self) -> int:
        return len(self.edges)

    def check_row(self, row: int) -> None:
        """Raise `GraphError` for a row that is no edge's."""
        if not 0 <= row < len(self):
            raise GraphError(f"there is no edge {row}: rows go from 0 to {len(self) - 1}")

    def switches(self, history: History) -> Words:
        """The decision on each edge (E,): disabled, enabled, right, registered or ""."""
        out = np.full(len(self), "", dtype="U16")
        for pair, switch in history.switches.items():
            out[self.rows.get(pair, [])] = switch
        return out

    def weights(self, history: History) -> Floats:
        """The weights (E,) after the decisions: 0 or 1, or the base where nothing was decided."""
        switches, weights = self.switches(history), self.base.copy()
        weights[switches == DISABLED] = 0.0
        weights[(switches == ENABLED) & self.let_in] = 1.0
        weights[(switches == RIGHT) | ((switches == REGISTERED) & self.added)] = 1.0
        return weights

    def with_edge(self, i: int, j: int, found: Registration) -> Table:
        """The table with a new edge, which counts while its registration is not undone."""
        row = replace(Edges.of([[i, j]], BY_HAND).with_registrations([found]), status=np.array([USED]))
        edges = Edges.joined([self.edges, row])
        graph = edges.as_graph(self.graph.vertex_ids)
        graph = replace(graph, dimension=self.graph.dimension, fixed=self.graph.fixed, priors=self.graph.priors)
        base, yes = np.append(self.base, 0.0), [True]
        return Table(edges, graph, base, np.append(self.let_in, yes), np.append(self.added, yes), _rows(graph))


def judge(table: Table, history: History, options: DiagnosisOptions) -> Judged:
    """Diagnose the edges that are not off or rejected; the others keep the verdicts that they had."""
    without = table.weights(history) == 0
    off = (table.switches(history) == DISABLED) | (without & (table.added | (table.edges.status == REJECTED)))
    rows = np.flatnonzero(~off)
    found = diagnose(table.graph.select(rows), options)
    why = np.array(found.reason, dtype=np.str_)
    edges = table.edges.put(rows, verdict=found.verdict, probability=found.probability, why=why)
    return Judged(edges, found, rows)


class Settler:
    """Solves the table of a subject for any history of decisions; edges can be added to it."""

    def __init__(self, subject: Subject) -> None:
        self._truth = subject.truth
        self._solution = subject.solution
        self._before = 0, subject.solution.world_from_cam
        self.table = Table.of(subject)
        self._editor = _editor(subject.graph, replace(subject.solution, weights=self.table.base))
        self.settled = self._settled(0, subject.solution, 0.0)

    def add(self, i: int, j: int, found: Registration) -> None:
        """Put a new edge into the table."""
        self.table = self.table.with_edge(i, j, found)
        weights = np.zeros(len(self.table)) if self._editor is None else np.append(self._editor.weights, 0.0)
        self._solution = replace(self._solution, weights=weights)
        self._editor = _editor(self.table.graph, self._solution)

    def solve(self, history: History, revision: int) -> Settled:
        """The poses after the decisions, of a few Newton steps. Raises `GraphError` where no edge would count."""
        weights, began = self.table.weights(history), time.perf_counter()
        if not (weights > 0).any():
            raise GraphError("no edge would count: enable one first")
        if self._editor is None:
            self._solution = _with_weights(self.table.graph, weights, self._solution.world_from_cam)
        else:
            changed = np.flatnonzero(weights != self._editor.weights)
            self._editor.reweight(changed, weights[changed])
            self._solution = self._editor.solve(PREVIEW_STEPS)
        self.settled = self._settled(revision, replace(self._solution, weights=weights), time.perf_counter() - began)
        return self.settled

    def checked(self, history: History, revision: int) -> Settled | None:
        """Better poses than the present ones; None where these have converged to the lowest cost found.

        Solving from the edges alone finds a lower minimum where wrong edges had left the poses near another. Without
        such a minimum the present poses are solved until they converge.
        """
        counted = np.flatnonzero(self.table.weights(history) > 0)
        before, began = self._solution, time.perf_counter()
        converged = before.converged is not False
        if converged and len(counted) > MOST_CHECKED or self._editor is None:
            return None
        found = solve(self.table.graph.select(counted))
        if found.metrics["objective"] < (1 - LOWER) * before.metrics["objective"]:
            poses, weights = found.world_from_cam, np.zeros(len(self.table))
            weights[counted] = found.weights
            if not len(self.table.graph.fixed):
                poses = align(poses, before.world_from_cam).apply(poses)
            self._solution = replace(found, world_from_cam=poses, weights=weights)
            self._editor = _editor(self.table.graph, self._solution)
        elif converged:
            return None
        else:
            self._solution = self._editor.solve()
        seconds = self.settled.seconds + time.perf_counter() - began
        self.settled = self._settled(revision, self._solution, seconds)
        return self.settled

    def _settled(self, revision: int, solution: Solution, seconds: float) -> Settled:
        """The solution with residuals and errors; its movement is from the last poses of the revision before."""
        residual_m, residual_rad = edge_residuals(self.table.graph, solution.world_from_cam)
        if revision != self._before[0]:
            self._before = revision, self.settled.world_from_cam
        return Settled(
            revision=revision,
            world_from_cam=solution.world_from_cam,
            component=solution.component,
            weights=np.asarray(solution.weights),
            residual_m=residual_m,
            residual_rad=residual_rad,
            seconds=seconds,
            moved_m=moved_m(self._before[1], solution.world_from_cam),
            error_m=error_m(solution.world_from_cam, self._truth),
            converged=solution.converged is not False,
        )


def moved_m(before: Floats, after: Floats) -> float:
    """The farthest that a position moved between two sets of poses (V, 4, 4), the later aligned to the former."""
    known = se3.has_pose(before) & se3.has_pose(after)
    if not known.any():
        return 0.0
    aligned = align(after[known], before[known]).apply(after[known])
    return float(np.linalg.norm(aligned[:, :3, 3] - before[known, :3, 3], axis=1).max())


def error_m(world_from_cam: Floats, truth: Floats) -> float | None:
    """The RMS error of the positions after alignment to the truth (V, 4, 4); None of fewer than three true poses."""
    if se3.has_pose(truth).sum() < 3:
        return None
    return absolute_error(world_from_cam, truth).rmse_m


def _editor(graph: ViewGraph, solution: Solution) -> GraphEditor | None:
    """An editor that updates the solution; None where the graph has priors, which the editor does not take."""
    if graph.priors is not None and len(graph.priors.vertices):
        return None
    return GraphEditor(graph, solution)


def _rows(graph: ViewGraph) -> dict[str, list[int]]:
    """The rows of the edges of each pair of vertex ids `a-b`, in both directions."""
    rows: dict[str, list[int]] = {}
    for pairs in (graph.edges, graph.edges[:, ::-1]):
        for row, name in enumerate(pair_names(graph.vertex_ids, pairs)):
            rows.setdefault(name, []).append(row)
    return rows


def _with_weights(graph: ViewGraph, weights: Floats, start: Floats) -> Solution:
    """The graph with its information times the weights (E,), solved from poses (V, 4, 4) without an editor."""
    counted = np.flatnonzero(weights > 0)
    chosen = graph.select(counted)
    chosen = replace(chosen, information=chosen.information * weights[counted, None, None])
    found = solve(chosen, start=start, initial="given")
    return replace(found, weights=weights)
