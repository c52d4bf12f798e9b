"""Solve a pose-graph file: any registered format is read, and written back with its ids, edges and order."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from hodge_pipeline import registry
from hodge_pipeline.complex.chi2 import has_unit_information
from hodge_pipeline.complex.components import connected_components
from hodge_pipeline.complex.conventions import inverted_notes
from hodge_pipeline.diagnosis.options import DiagnosisOptions
from hodge_pipeline.diagnosis.robust import solve_robust
from hodge_pipeline.errors import GraphError, SourceError, WorkspaceError
from hodge_pipeline.pairs.edits import joining
from hodge_pipeline.recipe.recipe_file import recipe_names
from hodge_pipeline.solvers.backbone.credible import credible_steps
from hodge_pipeline.solvers.backbone.levels import SIGMAS
from hodge_pipeline.solvers.backbone.sequence import sequential_edges
from hodge_pipeline.solvers.backbone.trust import AUTO
from hodge_pipeline.solvers.explained import degrees_of_freedom
from hodge_pipeline.solvers.maximum_likelihood import ObjectiveName, solve
from hodge_pipeline.solvers.setup import InitialName
from hodge_pipeline.sources.inspect import guess_reader
from hodge_pipeline.sources.unknown import without_frames
from hodge_pipeline.store import artifacts
from hodge_pipeline.store.edge_table import read_edges
from hodge_pipeline.store.workspace import EDGES_FILE, GRAPH_FILE, SOLVED_FILE
from hodge_pipeline.types import Bools, Floats, Solution, Source, Trajectory, ViewGraph
from hodge_pipeline.types.text import command, counted, in_unit

ROUNDING = 1e-15
"""Share of the first cost that rounding leaves of one that vanishes."""
GRAPH_WRITERS = ("g2o", "open3d_pose_graph")
"""Writers of a graph, whose poses are in the order of its vertices."""
OBJECTIVES = {"full": "chi2", "isotropic": "F"}
"""How a headline names each objective."""
SESYNC_UNITS = np.array([2.0, 2.0, 2.0, 1.0, 1.0, 1.0])
"""SE-Sync reads g2o's information of the quaternion's vector part, half an angle, as that of the angle."""
UNTOLD = "the odometry states no errors of some axes: --robust learns them from the loops, which may be far better"
MOST_POSES_FILMED = 20_000
"""Above it the recording shows the start and the end of the solve only."""


@dataclass(frozen=True)
class SolveOptions:
    """How a file is solved; `disable` names pairs of vertex ids, `a-b`, and `trust` the edges of a backbone."""

    objective: ObjectiveName = "full"
    initial: InitialName = "chordal"
    robust: bool = False
    certificate: bool = False
    sesync_units: bool = False
    disable: Sequence[str] = ()
    trust: str = AUTO
    time_limit_s: float = math.inf


@dataclass(frozen=True)
class SolvedFile:
    """What was read, its solution with a weight for every edge of the file, how it was solved and in what time."""

    source: Source
    graph: ViewGraph
    solution: Solution
    choices: SolveOptions
    cpu_s: float
    wall_s: float

    @property
    def start(self) -> Floats | None:
        """The file's own poses, where it has one for each vertex."""
        return None if self.source.trajectory is None else self.source.trajectory.world_from_cam

    @property
    def doubt(self) -> str:
        """Why the poses are not to be trusted; "" where nothing speaks against them."""
        solution = self.solution
        if solution.confirmed is False:
            return "NOT CONFIRMED by the cycles of its edges"
        if solution.certified is False:
            return "NOT proven to be the global minimum"
        if solution.converged is False:
            return "stopped before it converged"
        if (excess := solution.metrics.get("priors_excess", 0.0)) > SIGMAS:
            return f"priors are off by {excess:.2g} times what they state"
        what = "edges and priors" if self._has_priors else "edges"
        return f"{what} are off by {excess:.2g} times what they state" if (excess := self.excess) > SIGMAS else ""

    @property
    def _has_priors(self) -> bool:
        return self.graph.priors is not None and len(self.graph.priors.vertices) > 0

    @property
    def excess(self) -> float:
        """By how many times what they state edges are off, √(χ² / degrees of freedom); 0 where nothing tells.

        So it is of a robust solve, which judges this itself, of another objective than χ², and without redundant edges
        or information.
        """
        graph, solution = self.graph.select(self.solution.weights > 0), self.solution
        if self.choices.robust or "chi2" not in solution.metrics or has_unit_information(graph):
            return 0.0
        freedom = degrees_of_freedom(graph, solution)
        return math.sqrt(max(solution.metrics["objective"], 0.0) / freedom) if freedom > 0 else 0.0

    @property
    def headline(self) -> str:
        """The verdict: the objective before and after, the only measure of poses that a graph of edges gives."""
        summary = self.summary()
        before, after, name = summary["cost_before"], summary["cost_after"], OBJECTIVES[summary["objective"]]
        after = after if after > ROUNDING * max(before or 0.0, 1.0) else 0.0
        fell = f"{name} {after:.6g}" if before is None else f"{name} {before:.6g} → {after:.6g}"
        if not self.doubt and not self._has_priors and summary["edges_ignored"] == summary["edges"]:
            return "Nothing to solve: no edge joins two vertices with information, so every pose is as it was"
        if self.choices.robust and self.solution.confirmed is None and "tested_edges" in self.solution.metrics:
            again = summary["edges"] - summary["edges_ignored"] - summary["poses"] + summary["pieces"]
            alone = "and priors" if self._has_priors else "alone"
            alone = f"and {again} that state the same steps again" if again > 0 else alone
            others = "other edge" if summary["edges_ignored"] == 1 else f"{summary['edges_ignored']} others"
            others = f"nothing confirms the {others} (without --robust all count)"
            where = f", {self.torn}" if self.torn else ""
            doubt = f", but {self.doubt}" if self.doubt else ""
            return f"Solved by consecutive edges {alone}{where}, since {others}{doubt}: {fell}"
        proven = ", globally optimal" if summary["certified"] and not self.doubt else ""
        doubts = " and ".join(filter(None, (self.doubt, self.torn)))
        return f"Solved{proven}, but {doubts}: {fell}" if doubts else f"Solved{proven}: {fell}"

    @property
    def torn(self) -> str:
        """In how many pieces the poses are, where edges that the solve left out join these; "" elsewhere."""
        given = self.graph.edges[~disabled_edges(self.graph, self.choices.disable)]
        pieces = int(self.solution.component.max(initial=-1)) + 1
        joined = int(connected_components(given, self.graph.vertex_count).max(initial=-1)) + 1
        return f"in {pieces} pieces without the edges left out" if pieces > joined else ""

    def summary(self) -> dict[str, Any]:
        """The numbers of the solve under keys that stay, for `--json` and the report."""
        metrics, graph = self.solution.metrics, self.graph
        return {
            "poses": graph.vertex_count,
            "edges": graph.edge_count,
            "edges_ignored": int((self.solution.weights <= 0).sum()),
            "dimension": graph.dimension,
            "in_metres": self.source.in_metres,
            "pieces": int(self.solution.component.max(initial=-1)) + 1,
            "objective": "full" if "chi2" in metrics else "isotropic",
            "cost_before": metrics.get("objective_at_start"),
            "cost_after": metrics["objective"],
            "converged": self.solution.converged is not False,
            "certified": self.solution.certified,
            "confirmed": self.solution.confirmed,
            "stopped_by": self.solution.stopped_by,
            "gap_bound": metrics.get("gap_bound"),
            "newton_steps": int(metrics["iterations"]),
            "cg_steps": int(metrics["cg_steps"]),
            "cpu_s": self.cpu_s,
            "wall_s": self.wall_s,
            "notes": list(dict.fromkeys((*self.source.notes, *self.solution.notes))),
        }


def read_graph(path: Path) -> Source:
    """A source with the graph at a path, of any registered format or a run folder; a note where motions look inverted.

    Raises `SourceError` where there is no graph, `WorkspaceError` where the folder of a solve is damaged.
    """
    folder, path = path, path / GRAPH_FILE if (path / GRAPH_FILE).is_file() else path
    reader = guess_reader(path)
    source = reader.open(path)
    graph = source.graph
    if graph is None:
        recipe = registry.name_of(reader) if registry.name_of(reader) in recipe_names() else "RECIPE"
        run = command("hodge", "run", recipe, "--source", path, "--out", "RUN")
        rest = f"; its frames give one: {run}, then give RUN" if source.frames else f" but {without_frames(source)}"
        raise SourceError(f"{path}: holds no graph of measured edges{rest}")
    source = replace(source, notes=(*inverted_notes(graph), *source.notes))
    if not (folder / SOLVED_FILE).is_file():
        return source
    in_metres = source.in_metres and _in_metres(folder / SOLVED_FILE)
    return replace(source, graph=_with_names(graph, folder / EDGES_FILE), in_metres=in_metres)


def _with_names(graph: ViewGraph, table: Path) -> ViewGraph:
    """The graph with the names that its vertices have in the table of a solve's edges, which g2o cannot hold."""
    edges, names = read_edges(table)
    if len(edges) != graph.edge_count:
        return graph
    known = dict(zip(graph.edges.ravel().tolist(), names[edges.pairs].ravel().tolist(), strict=True))
    numbers = graph.vertex_ids.astype(np.str_).tolist()
    called = [known.get(row, number) for row, number in enumerate(numbers)]
    return graph if called == numbers else replace(graph, vertex_ids=np.array(called))


def _in_metres(solved: Path) -> bool:
    """Whether the numbers of a solve say that lengths are in metres, which a graph's file cannot say."""
    try:
        return bool(artifacts.read_json(solved).get("in_metres", True))
    except (OSError, ValueError, AttributeError) as error:
        raise WorkspaceError(f"{solved}: is not what a solve writes ({error}): solve the graph again") from error


def disabled_edges(graph: ViewGraph, pairs: Sequence[str]) -> Bools:
    """Where (E,) an edge joins one of the pairs of vertex ids `a-b`, in either direction; parallel ones all.

    Raises `GraphError` where a pair has no edge.
    """
    found = np.zeros(graph.edge_count, bool)
    for pair in pairs:
        hit = joining(graph.vertex_ids, graph.edges, pair)
        if not hit.any():
            raise GraphError(
                f"--disable {pair}: no edge joins these vertices: give two vertex ids of the file, as 12-87"
            )
        found |= hit
    return found


def solve_file(path: Path, options: SolveOptions) -> SolvedFile:
    """The graph at a path, solved. Raises `SourceError`, `GraphError` where it cannot be read or solved."""
    source = read_graph(path)
    assert source.graph is not None
    start = None if source.trajectory is None else source.trajectory.world_from_cam
    if options.initial == "given" and start is None:
        raise SourceError(f"{source.path}: has no pose for every vertex to start from: use --start chordal")
    off = disabled_edges(source.graph, options.disable)
    graph = source.graph.select(~off)
    if options.sesync_units and graph.dimension == 3:
        graph = replace(graph, information=graph.information * np.outer(SESYNC_UNITS, SESYNC_UNITS))
    cpu_s, wall_s = time.process_time(), time.monotonic()
    solution = _solved(graph, start, options)
    if not options.robust and not credible_steps(graph, sequential_edges(graph))[1]:
        solution = replace(solution, notes=(UNTOLD, *solution.notes))
    cpu_s, wall_s = time.process_time() - cpu_s, time.monotonic() - wall_s
    weights = np.zeros(len(off))
    weights[~off] = solution.weights
    notes = tuple(in_unit(note, source.in_metres) for note in solution.notes)
    if off.any():
        notes = (f"{counted(int(off.sum()), 'edge is|edges are')} disabled", *notes)
    return SolvedFile(source, source.graph, replace(solution, weights=weights, notes=notes), options, cpu_s, wall_s)


def _solved(graph: ViewGraph, start: Floats | None, options: SolveOptions) -> Solution:
    if options.robust:
        return solve_robust(
            graph,
            start=start,
            diagnosis=DiagnosisOptions(trust=options.trust),
            objective=options.objective,
            certificate=options.certificate,
        )
    return solve(
        graph,
        start=start,
        objective=options.objective,
        initial=options.initial,
        certificate=options.certificate,
        time_limit_s=options.time_limit_s,
        keep_history=graph.vertex_count <= MOST_POSES_FILMED,
    )


def write_solved(path: Path, solved: SolvedFile, writer: str = "g2o") -> tuple[str, ...]:
    """Write the solved poses; a writer of graphs also gets every edge as measured, ignored ones too, in the order read.

    A writer of poses gets them in the order of the vertices' numbers. Gives what the format lost, a line each.
    """
    poses, graph = solved.solution.world_from_cam, solved.graph
    trajectory = Trajectory(np.arange(len(poses), dtype=float), poses)
    if writer not in GRAPH_WRITERS:
        trajectory = vertex_trajectory(graph, poses)
    graph_alone = replace(solved.source, frames=(), trajectory=trajectory)
    told: tuple[str, ...] = registry.load("writers", writer)().write(path, graph_alone)
    return told[1:]


def vertex_trajectory(graph: ViewGraph, world_from_vertex: Floats) -> Trajectory:
    """Poses (V, 4, 4) by the numbers of their vertices, which become the stamps; vertices with names count by row."""
    ids = graph.vertex_ids
    numbers = ids.astype(float) if ids.dtype.kind in "iu" else np.arange(len(ids), dtype=float)
    order = np.argsort(numbers, kind="stable")
    return Trajectory(numbers[order], world_from_vertex[order])
