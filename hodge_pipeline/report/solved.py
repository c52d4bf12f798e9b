"""The run folder of a solved pose-graph file: graph, edges, report, recording."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from hodge_pipeline.diagnosis.diagnosis import diagnose
from hodge_pipeline.diagnosis.options import DiagnosisOptions
from hodge_pipeline.evaluation.residuals import with_residuals
from hodge_pipeline.recording.solved import record_graph
from hodge_pipeline.refine.pose_graph import SolvedFile, write_solved
from hodge_pipeline.report.contents import Pictures, RefinementSummary, Report, SourceSummary, StageRow
from hodge_pipeline.report.diagnosis_page import LISTED
from hodge_pipeline.report.summary import graph_summary, worst_edges
from hodge_pipeline.report.write import write_report
from hodge_pipeline.store import artifacts
from hodge_pipeline.store.edge_table import write_edges
from hodge_pipeline.store.store import versions
from hodge_pipeline.store.workspace import EDGES_FILE, GRAPH_FILE, SOLVED_FILE, make_folder
from hodge_pipeline.types import Edges, Floats
from hodge_pipeline.types.notes import notes_of
from hodge_pipeline.types.text import counted


def write_run_folder(folder: Path, solved: SolvedFile) -> tuple[str, ...]:
    """Write the folder, made if it is not there; what the graph's file and the recording left out, in words."""
    make_folder(folder, "--run")
    lost, edges = write_solved(folder / GRAPH_FILE, solved), _edges(solved)
    write_edges(folder / EDGES_FILE, edges, solved.graph.vertex_ids, has_metres=solved.source.in_metres)
    artifacts.write_json(folder / SOLVED_FILE, solved.summary())
    write_report(folder, _report(solved, edges))
    source, solution = solved.source, solved.solution
    start = solution.world_from_cam if solved.start is None else solved.start
    sets, is_scanner = _before(solved), not source.of_cameras
    return lost + record_graph(
        folder, source.name, solved.graph, start, solution, sets, source.notes, is_scanner=is_scanner
    )


def _edges(solved: SolvedFile) -> Edges:
    """All edges with what the poses leave of them; of a robust solve with each verdict, as in `hodge diagnose`."""
    solution, edges = solved.solution, Edges.measured(solved.graph)
    if solved.choices.robust:
        edges = diagnose(solved.graph, DiagnosisOptions(trust=solved.choices.trust)).put_into(edges)
    return with_residuals(edges, solution.world_from_cam, solution.weights)


def _before(solved: SolvedFile) -> dict[str, Floats]:
    return {} if solved.start is None else {"start": solved.start}


def _report(solved: SolvedFile, edges: Edges) -> Report:
    source, graph, solution = solved.source, solved.graph, solved.solution
    sets, summary = {**_before(solved), "result": solution.world_from_cam}, solved.summary()
    reason = f"{counted(summary['edges'], 'edge')}, {summary['edges_ignored']} of them ignored"
    return Report(
        title=source.name,
        source=SourceSummary(
            source.name,
            str(source.path),
            graph.vertex_count,
            notes=source.notes,
            format="pose graph",
            kind="poses",
            is_scanner=not source.of_cameras,
        ),
        before="start",
        refinement=RefinementSummary("worse" if solved.doubt else "solved", solved.headline, reason),
        graph=graph_summary(edges, graph.vertex_ids, solution.component),
        worst_edges=worst_edges(edges, graph.vertex_ids, LISTED),
        stages=(StageRow("solve", solved.wall_s, solved.cpu_s, float("nan")),),
        notes=notes_of("solver", solution.notes),
        versions=versions(),
        pictures=replace(
            Pictures.of_graph(sets, graph, solution.component),
            convergence={"solve": tuple(step.objective for step in solution.history)},
        ),
        has_metres=source.in_metres,
    )
