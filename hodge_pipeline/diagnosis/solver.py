"""Poses of the edges that the diagnosis keeps, solved robustly, and checked again against the edges left out."""

from __future__ import annotations

from dataclasses import dataclass as plain_dataclass
from dataclasses import replace

import numpy as np
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass as stage

from hodge_pipeline.complex.judging import left_over, squares_at_both_ends
from hodge_pipeline.diagnosis.diagnosis import diagnose
from hodge_pipeline.diagnosis.options import DiagnosisOptions
from hodge_pipeline.diagnosis.result import SUSPECT, WRONG, Diagnosis
from hodge_pipeline.solvers.backbone.solve import solve_on_backbone
from hodge_pipeline.solvers.backbone.trust import NONE, find_backbone
from hodge_pipeline.solvers.maximum_likelihood import ObjectiveName
from hodge_pipeline.solvers.robust import CHI2_99_PLANAR, CHI2_99_SPATIAL, solve_robust
from hodge_pipeline.solvers.weights import edge_weights
from hodge_pipeline.types import Floats, Ints, Solution, ViewGraph

MEDIAN_CHI2 = {2: 2.366, 3: 5.348}
"""Of χ² with 3 and 6 degrees of freedom."""
TAILS = 1.6
"""Where only rotation, or only translation, makes most of χ², its tail is that of half the degrees of freedom."""
LEAST_WEIGHT = 0.1
ROUNDS = 3


@plain_dataclass(frozen=True)
class _Attempt:
    """The solution of some edges: their rows, and the χ² (E,) of all edges at it, ∞ between pieces."""

    rows: Ints
    solution: Solution
    chi2: Floats
    limit: float


@stage(frozen=True, config=ConfigDict(extra="forbid"))
class DiagnosedSolver:
    """Edges that the diagnosis calls wrong or suspect are left out, the others weigh their probability; GNC solves."""

    diagnosis: DiagnosisOptions = Field(
        default=DiagnosisOptions(),
        description="what judges the edges, as in a recipe's section `diagnosis`",
    )
    objective: ObjectiveName = Field(default="full", description="what the edges that are kept are solved with")
    readmit: bool = Field(
        default=True,
        description="whether a suspect edge that agrees with the solution is taken in again, and all solved anew",
    )

    def solve(self, graph: ViewGraph, world_from_cam: Floats) -> Solution:
        """The poses; each piece of the kept edges keeps its own gauge. Weights are 0 for edges left out."""
        if (backbone := find_backbone(graph, self.diagnosis.trust)) is not None:
            return solve_on_backbone(graph, backbone, start=world_from_cam, objective=self.objective)
        found = diagnose(graph, replace(self.diagnosis, trust=NONE))
        share = np.clip(np.nan_to_num(found.probability, nan=0.5), LEAST_WEIGHT, 1.0)
        rows, back = np.flatnonzero(found.kept), np.zeros(0, np.int64)
        attempt = _attempt(graph, found, share, rows, world_from_cam, self.objective)
        for _ in range(ROUNDS if self.readmit else 0):
            agrees = (attempt.chi2 <= attempt.limit) & (found.verdict == SUSPECT)
            back = np.setdiff1d(np.flatnonzero(agrees), attempt.rows)
            if not len(back):
                break
            rows = np.union1d(attempt.rows, back)
            attempt = _attempt(graph, found, share, rows, world_from_cam, self.objective)
        return _whole(graph, found, attempt)


def _attempt(
    graph: ViewGraph, found: Diagnosis, share: Floats, rows: Ints, start: Floats, objective: ObjectiveName
) -> _Attempt:
    chosen = graph.select(rows)
    # information is often right only in its proportions: the gate is scaled by the median χ² of the kept edges
    size = 2 if graph.dimension == 2 else 3
    usual = _chi2(graph, found.world_from_cam, found.piece)
    finite = usual[rows][np.isfinite(usual[rows])]
    scale = max(float(np.median(finite)) / MEDIAN_CHI2[size], 1e-12) if len(finite) else 1.0
    limit = TAILS * (CHI2_99_PLANAR if size == 2 else CHI2_99_SPATIAL) * scale
    solution = solve_robust(
        chosen, start=start, confidence=share[rows], threshold=limit, objective=objective, trust=NONE
    )
    chi2 = _chi2(graph, solution.world_from_cam, solution.component)
    return _Attempt(rows, solution, chi2, limit)


def _chi2(graph: ViewGraph, poses: Floats, piece: Ints) -> Floats:
    """χ² (E,) with isotropic weights; ∞ between two pieces."""
    weights = edge_weights(graph, 2 if graph.dimension == 2 else 3)
    turned, shifted = squares_at_both_ends(graph.i_from_j, left_over(graph, poses))
    kappa = weights.kappa if graph.dimension == 2 else 2 * weights.kappa
    apart = piece[graph.edges[:, 0]] != piece[graph.edges[:, 1]]
    return np.where(apart, np.inf, kappa * turned + weights.tau * shifted)


def _whole(graph: ViewGraph, found: Diagnosis, attempt: _Attempt) -> Solution:
    """The solution with a weight for every edge, and notes of what was left out and what checked out."""
    weights = np.zeros(graph.edge_count)
    weights[attempt.rows] = attempt.solution.weights
    out = weights == 0
    wrong, suspect = found.verdict == WRONG, found.verdict == SUSPECT
    agreeing = int((out & (attempt.chi2 <= attempt.limit)).sum())
    notes = (
        f"{int((wrong & out).sum())} wrong and {int((suspect & out).sum())} suspect edges left out by the diagnosis, "
        f"{int((out & ~wrong & ~suspect).sum())} more by the solver",
        f"checked again: {int((suspect & ~out).sum())} suspect edges agree with the poses and count; "
        f"{agreeing} edges agree with the poses and stay out",
        *found.notes,
        *attempt.solution.notes,
    )
    metrics = {**attempt.solution.metrics, "left_out_edges": float(out.sum())}
    return replace(attempt.solution, weights=weights, notes=notes, metrics=metrics)
