"""Robust poses: the diagnosis judges the edges, and those that it keeps are solved with Student's t."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TypeAlias

import numpy as np
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass as stage

from hodge_pipeline import se3
from hodge_pipeline.complex.checks import check_graph
from hodge_pipeline.complex.chi2 import has_unit_information
from hodge_pipeline.complex.closing import closes_better_than_chance
from hodge_pipeline.complex.components import connected_components
from hodge_pipeline.diagnosis.cycles import is_folded
from hodge_pipeline.diagnosis.diagnosis import DEFAULTS, backbone_or_diagnosis, errs_as_stated, informed, kept_graph
from hodge_pipeline.diagnosis.options import DiagnosisOptions
from hodge_pipeline.diagnosis.result import SUSPECT, WRONG, Diagnosis
from hodge_pipeline.diagnosis.robust_priors import excess_of_priors, left_out_note, right_priors
from hodge_pipeline.solvers.backbone.trust import Backbone
from hodge_pipeline.solvers.explained import is_explained
from hodge_pipeline.solvers.maximum_likelihood import ObjectiveName, solve
from hodge_pipeline.solvers.reweighted import reweighted
from hodge_pipeline.solvers.setup import check_choice, held_rows
from hodge_pipeline.solvers.weights import dimension_of, edge_weights
from hodge_pipeline.types import Bools, Floats, Solution, ViewGraph
from hodge_pipeline.types.text import counted

Solver: TypeAlias = Callable[[ViewGraph, Floats], Solution]
"""The maximum-likelihood solution of a graph, from poses (V, 4, 4)."""


def solve_robust(
    graph: ViewGraph,
    *,
    start: Floats | None = None,
    diagnosis: DiagnosisOptions = DEFAULTS,
    objective: ObjectiveName = "full",
    certificate: bool = False,
) -> Solution:
    """The poses of the edges that the diagnosis keeps; `weights (E,)` are from 0 to 1 for these and 0 for the others.

    `diagnosis`: how the edges are judged, and which are trusted as a backbone. Where the information explains the
    residuals of the kept edges, the poses are their maximum-likelihood ones; else kept edges have weights by Student's
    t, 0 beyond the gate of `student_weight`. The graph's fixed vertices stay at their start. Components are those of
    the kept edges. `confirmed` is False where edges are left out, or disagree by more than they state, and the cycles
    of the others close no better than by chance; and where consecutive edges are folded. Priors that contradict the
    kept edges and most other priors are left out, and a note counts them.
    """
    check_choice("objective", objective, ObjectiveName)
    start = None if start is None else np.asarray(start, float)
    check_graph(graph, start)
    found = backbone_or_diagnosis(graph, diagnosis)
    fixed, unheld = held_rows(graph, start)

    def solved(chosen: ViewGraph, poses: Floats, certificate: bool = certificate) -> Solution:
        return solve(
            chosen,
            start=start if len(fixed) else _placed(chosen, poses, start),
            initial="chordal" if len(fixed) or graph.priors is not None else "given",
            objective=objective,
            fixed=fixed,
            certificate=certificate,
        )

    def with_priors(chosen: ViewGraph) -> Floats:
        return solved(chosen, found.world_from_cam, certificate=False).world_from_cam

    priors, right = graph.priors, np.ones(0, bool)
    if priors is not None and len(priors.vertices):
        right = right_priors(kept_graph(graph, found), priors, with_priors)
        graph = replace(graph, priors=priors.select(right))
    final = (
        _without_backbone(graph, found, solved) if isinstance(found, Diagnosis) else _on_backbone(graph, found, solved)
    )
    metrics = {**final.metrics, "kept_edges": float((final.weights > 0).sum())}
    notes = (*unheld, *final.notes)
    if priors is not None and graph.priors is not None and len(right):
        metrics["priors_excess"] = excess_of_priors(graph, graph.priors, final.world_from_cam)
        notes = notes if right.all() else (left_out_note(graph, priors, right, final.world_from_cam), *notes)
    return replace(final, notes=notes, metrics=metrics)


def _on_backbone(graph: ViewGraph, backbone: Backbone, solved: Solver) -> Solution:
    """The poses of a backbone and its confirmed loops: by the information, where it constrains every axis and explains
    the residuals, else by the learned errors; `confirmed` is None where no loop is.
    """
    chosen = informed(graph, backbone).select(np.flatnonzero(backbone.used))
    final = solved(chosen, backbone.world_from_cam) if backbone.chain.stated else None
    if final is None or not errs_as_stated(graph, backbone, chosen, final):
        final = solved(backbone.weighted(graph), backbone.world_from_cam)
    weights = np.zeros(graph.edge_count)
    weights[backbone.used] = final.weights
    return replace(
        final,
        weights=weights,
        notes=(*backbone.notes, *final.notes),
        metrics={**final.metrics, "tested_edges": float(np.isfinite(backbone.chi2).sum())},
        confirmed=True if backbone.found.confirmed else None,
    )


def _without_backbone(graph: ViewGraph, found: Diagnosis, solved: Solver) -> Solution:
    """The poses of the edges that a diagnosis without a backbone keeps."""
    by_learned = informed(graph, found)
    stated = edge_weights(graph, dimension_of(graph))
    kept = found.kept & stated.used

    def solved_with(weights: Floats, poses: Floats) -> Solution:
        rows = np.flatnonzero(weights)
        chosen = by_learned.select(rows)
        return solved(replace(chosen, information=weights[rows, None, None] * chosen.information), poses)

    weights = kept.astype(float)
    final = solved_with(weights, found.world_from_cam)
    if not is_explained(graph.select(np.flatnonzero(kept)), final):
        weights, final = reweighted(by_learned, weights, final, solved_with)
    whole = np.zeros(graph.edge_count)
    whole[np.flatnonzero(weights)] = final.weights * weights[np.flatnonzero(weights)]
    earlier = (*stated.notes, _kept_note(found, whole), *found.notes)
    notes = (*(note for note in earlier if note not in final.notes), *final.notes)
    return _with_confirmation(graph, stated.used, replace(final, weights=whole, notes=notes))


def _placed(graph: ViewGraph, poses: Floats, start: Floats | None) -> Floats:
    """The poses (V, 4, 4), the first vertex of each component moved to its start, by default the identity."""
    component = connected_components(graph.edges, graph.vertex_count)
    first = np.unique(component, return_index=True)[1]
    start = np.broadcast_to(np.eye(4), poses.shape) if start is None else start
    return np.asarray((start[first] @ se3.inverse(poses[first]))[component] @ poses)


def _kept_note(found: Diagnosis, weights: Floats) -> str:
    out = weights == 0
    reasons = found.verdict == WRONG, found.verdict == SUSPECT, found.kept
    wrong, suspect, more = (int((out & reason).sum()) for reason in reasons)
    return (
        f"{int((~out).sum())} of {len(out)} edges kept; {wrong} wrong and {suspect} suspect ones left out by the "
        f"diagnosis, {more} more by what the poses leave over"
    )


def _with_confirmation(graph: ViewGraph, usable: Bools, solution: Solution) -> Solution:
    """The solution with `confirmed` set: whether cycles of its used edges close better than by chance, and consecutive
    edges are not folded; None where nothing tests the edges.

    Edges that no solve can use (not `usable (E,)`) do not count as left out.
    """
    weights = solution.weights[usable]
    if is_folded(graph, solution.weights > 0, solution.world_from_cam):
        why = "consecutive edges are off by a large part of their own motion: the others fold the sequence upon itself"
    elif closes_better_than_chance(graph.select(np.flatnonzero(usable)), np.flatnonzero(weights)):
        return replace(solution, confirmed=True)
    elif left_out := int((weights == 0).sum()):
        edges = counted(left_out, "edge is|edges are")
        why = (
            f"{edges} left out, and the cycles of the others close no better than by chance: nothing confirms the poses"
        )
    elif has_unit_information(graph) or is_explained(graph, solution):
        note = "no edge is left out, and no cycles close better than by chance: nothing tests the edges"
        return replace(solution, notes=(*solution.notes, note))
    else:
        why = "the edges disagree by more than they state, and no cycles close better than by chance"
    return replace(solution, confirmed=False, notes=(why, *solution.notes))


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
