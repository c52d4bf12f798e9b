"""Robust poses: the diagnosis judges the edges, and those that it keeps are solved with Student's t."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass as stage

from hodge_pipeline import se3
from hodge_pipeline.complex.checks import check_graph
from hodge_pipeline.complex.components import connected_components
from hodge_pipeline.complex.judging import has_unit_information
from hodge_pipeline.diagnosis.confirmation import confirmed
from hodge_pipeline.diagnosis.diagnosis import DEFAULTS, diagnose, lattice_backbone
from hodge_pipeline.diagnosis.options import DiagnosisOptions
from hodge_pipeline.diagnosis.result import SUSPECT, WRONG, Diagnosis
from hodge_pipeline.solvers.backbone.solve import solve_on_backbone
from hodge_pipeline.solvers.backbone.trust import NONE, find_backbone
from hodge_pipeline.solvers.maximum_likelihood import ObjectiveName, solve
from hodge_pipeline.solvers.options import check_choice
from hodge_pipeline.solvers.reweighted import reweighted
from hodge_pipeline.solvers.setup import held_rows
from hodge_pipeline.solvers.stated import is_explained
from hodge_pipeline.solvers.weights import edge_weights, is_planar
from hodge_pipeline.types import Floats, Solution, ViewGraph


def solve_robust(
    graph: ViewGraph,
    *,
    start: Floats | None = None,
    diagnosis: DiagnosisOptions = DEFAULTS,
    objective: ObjectiveName = "full",
    dimension: Literal[2, 3] | None = None,
    certificate: bool = False,
) -> Solution:
    """The poses of the edges that agree, with `weights` 0 for the others and from 0 to 1 for those.

    `diagnosis`: how the edges are judged first, and which of them are trusted as a backbone. Where there is one, the
    loops that it and each other confirm are kept. Where the information explains what the kept edges leave over, the
    poses are the maximum-likelihood ones of these; else an edge that is kept weighs by Student's t what it leaves over,
    and nothing beyond the gate of `student_weight`. The graph's fixed vertices stay at their start. The components are
    those of the edges that are kept. `confirmed` is False where edges are left out and the cycles of those kept close
    no better than by chance.
    """
    check_choice("objective", objective, ObjectiveName)
    start = None if start is None else np.asarray(start, float)
    check_graph(graph, start)
    backbone = find_backbone(graph, diagnosis.trust)
    if backbone is None:
        found = diagnose(graph, replace(diagnosis, trust=NONE))
        backbone = lattice_backbone(graph, found, diagnosis)
    if backbone is not None:
        return solve_on_backbone(
            graph, backbone, start=start, objective=objective, dimension=dimension, certificate=certificate
        )
    fixed, unheld = held_rows(graph, start)
    known = replace(graph, information=found.information) if has_unit_information(graph) else graph

    def solved(weights: Floats, poses: Floats) -> Solution:
        rows = np.flatnonzero(weights)
        chosen = known.select(rows)
        held = start is not None and len(fixed) > 0
        return solve(
            replace(chosen, information=weights[rows, None, None] * chosen.information),
            start=start if held else _placed(chosen, poses, start),
            initial="chordal" if held or graph.priors is not None else "given",
            objective=objective,
            dimension=dimension,
            fixed=fixed,
            certificate=certificate,
        )

    kept = found.kept & graph.information.any(axis=(1, 2))
    weights = kept.astype(float)
    final = solved(weights, found.world_from_cam)
    if not is_explained(graph.select(np.flatnonzero(kept)), final):
        weights, final = reweighted(known, weights, final, solved)
    whole = np.zeros(graph.edge_count)
    whole[np.flatnonzero(weights)] = final.weights * weights[np.flatnonzero(weights)]
    on_information = edge_weights(graph, 2 if graph.dimension == 2 or is_planar(graph) else 3).notes
    told = (note for note in on_information if note not in final.notes)
    notes = (*unheld, *told, _told(found, whole), *found.notes, *final.notes)
    metrics = {**final.metrics, "kept_edges": float((whole > 0).sum())}
    return _with_confirmation(graph, found, replace(final, weights=whole, notes=notes, metrics=metrics))


def _placed(graph: ViewGraph, poses: Floats, start: Floats | None) -> Floats:
    """The poses (V, 4, 4), the first vertex of each component where it starts, without a start at the origin."""
    component = connected_components(graph.edges, graph.vertex_count)
    first = np.unique(component, return_index=True)[1]
    start = np.broadcast_to(np.eye(4), poses.shape) if start is None else start
    return np.asarray((start[first] @ se3.inverse(poses[first]))[component] @ poses)


def _told(found: Diagnosis, weights: Floats) -> str:
    out = weights == 0
    reasons = found.verdict == WRONG, found.verdict == SUSPECT, found.kept
    wrong, suspect, more = (int((out & reason).sum()) for reason in reasons)
    return (
        f"{int((~out).sum())} of {len(out)} edges kept; {wrong} wrong and {suspect} suspect ones left out by the "
        f"diagnosis, {more} more by what the poses leave over"
    )


def _with_confirmation(graph: ViewGraph, found: Diagnosis, solution: Solution) -> Solution:
    """The solution with `confirmed` set: whether cycles of its used edges close better than by chance."""
    if confirmed(graph, np.flatnonzero(solution.weights)):
        return replace(solution, confirmed=True)
    if left_out := int((~found.kept).sum() + (found.kept & (solution.weights == 0)).sum()):
        why = f"{left_out} edges are left out, and the cycles of the others close no better than by chance"
        note = f"{why}: nothing confirms the poses"
        return replace(solution, confirmed=False, notes=(note, *solution.notes))
    note = "no edge is left out, and no cycles close better than by chance: nothing tests the edges"
    return replace(solution, notes=(*solution.notes, note))


@stage(frozen=True, config=ConfigDict(extra="forbid"))
class RobustSolver:
    """Maximum-likelihood poses of the edges that the diagnosis keeps, weighed by Student's t."""

    diagnosis: DiagnosisOptions = Field(
        default=DiagnosisOptions(), description="what judges the edges, as in a recipe's section `diagnosis`"
    )
    objective: ObjectiveName = Field(
        default="full", description="what the edges that are kept are solved with, as in `maximum_likelihood`"
    )

    def solve(self, graph: ViewGraph, world_from_cam: Floats) -> Solution:
        """The poses; the first vertex of each component of the kept edges keeps its start pose."""
        return solve_robust(graph, start=world_from_cam, diagnosis=self.diagnosis, objective=self.objective)
