"""Robust poses: graduated non-convexity from a start with edges that short cycles confirm.

Yang, Antonante, Tzoumas and Carlone 2020, for graphs without a backbone that can be trusted. Where triangles test the
edges they give the initial weights; where none does, all edges begin with the same weight.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

import numpy as np
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass as stage

from hodge_pipeline.complex.checks import check_graph
from hodge_pipeline.complex.judging import chi2_by_information, left_over, mean_variances, squares_at_both_ends
from hodge_pipeline.solvers.backbone.solve import solve_on_backbone
from hodge_pipeline.solvers.backbone.trust import AUTO, find_backbone
from hodge_pipeline.solvers.confirmation import confirmed
from hodge_pipeline.solvers.cycle_consistency import edge_corruption, short_loops
from hodge_pipeline.solvers.maximum_likelihood import ObjectiveName, solve
from hodge_pipeline.solvers.minimise import descend_isotropic
from hodge_pipeline.solvers.newton import Limits, Point
from hodge_pipeline.solvers.options import check_choice, check_positive
from hodge_pipeline.solvers.setup import Setup, held_rows, prepare
from hodge_pipeline.types import Floats, Solution, ViewGraph

Kernel: TypeAlias = Literal["truncated", "geman_mcclure"]
CHI2_99_SPATIAL, CHI2_99_PLANAR = 16.812, 11.345
"""The 99 % quantiles of χ² with 6 and 3 degrees of freedom."""
READMISSIONS = 3
"""Solves in which edges that were left out count again, where they agree with the full information's minimum."""
WEIGHT_FLOOR = 1e-9
"""An edge that is left out keeps this share of its weight, so that the Laplacians stay definite."""
UNTESTED_WEIGHT = 0.1
TRUST_SPREADS = (0.1, 0.25, 0.5, 1.0)
"""Each is tried; the end with the least truncated cost is kept, which on real graphs is the one nearest the truth."""
KEPT_FROM = 0.5
LEAST_WEIGHT = 1e-3
STEP = 1.4
FIRST_STEPS, STEPS_EACH = 10, 2
"""Newton steps, of the start and of a round: more find no other edges."""
MAX_ROUNDS = 100
SETTLED = {"truncated": 1e-3, "geman_mcclure": 1e-2}
"""The change of the weights in a round that ends them."""


@dataclass(frozen=True)
class _Round:
    """A point, and the weights (used edges,) that led to it."""

    point: Point
    weights: Floats


def solve_robust(
    graph: ViewGraph,
    *,
    start: Floats | None = None,
    confidence: Floats | None = None,
    kernel: Kernel = "truncated",
    threshold: float | None = None,
    objective: ObjectiveName = "full",
    dimension: Literal[2, 3] | None = None,
    certificate: bool = False,
    trust: str = AUTO,
) -> Solution:
    """The poses of the edges that agree, with `weights` 1 for those and 0 for the others (between, for Geman–McClure).

    `threshold`: an edge is wrong where its χ² with isotropic weights exceeds this; None takes the 99 % quantile of
    right edges. `confidence (E,)`, above 0: what share of its information an edge weighs, and of its weight in the
    solution; the threshold is for its χ² with all of it. The graph's fixed vertices stay at their start. The
    components are those of the edges that are kept. `trust`: which edges are a backbone, see `find_backbone`; where
    there is one, the loops that it and each other confirm are kept, and kernel and threshold have no part. `confirmed`
    is False where edges are left out and the cycles of those kept close no better than by chance.
    """
    check_choice("kernel", kernel, Kernel)
    check_choice("objective", objective, ObjectiveName)
    if threshold is not None:
        check_positive("threshold", threshold, "χ²")
    start = None if start is None else np.asarray(start, float)
    check_graph(graph, start)
    if confidence is None and threshold is None and (backbone := find_backbone(graph, trust)) is not None:
        return solve_on_backbone(
            graph, backbone, start=start, objective=objective, dimension=dimension, certificate=certificate
        )
    fixed, unheld = held_rows(graph, start)
    setup = prepare(graph, start, fixed, dimension)
    limit = threshold or (CHI2_99_PLANAR if setup.dimension == 2 else CHI2_99_SPATIAL)
    problem = setup.problem
    # the isotropic objective counts a rotation of θ as 2 κ θ²; in the plane κ is the information itself, so twice
    setup = replace(setup, problem=replace(problem, kappa=problem.kappa / 2)) if setup.dimension == 2 else setup
    corruption = _corruption(graph, setup, limit)
    share = np.ones(graph.edge_count) if confidence is None else np.asarray(confidence, float)
    search = _Search(setup, _Judge.of(graph, setup), share[setup.weights.used], limit, kernel)
    tried = [end for spread in TRUST_SPREADS for end in search.ends(_trust(corruption, spread))]
    last = min(tried, key=lambda end: search.truncated_cost(end.point))
    tested = int((~np.isnan(corruption)).sum())
    weights = np.zeros(graph.edge_count)
    weights[setup.weights.used] = np.round(last.weights) if kernel == "truncated" else last.weights
    weights = np.where(weights > LEAST_WEIGHT, weights * share, 0.0)

    def solved(poses: Floats) -> Solution:
        kept = np.flatnonzero(weights)
        chosen = graph.select(kept)
        return solve(
            replace(chosen, information=weights[kept, None, None] * chosen.information),
            start=poses,
            initial="given" if graph.priors is None else "chordal",
            objective=objective,
            dimension=2 if setup.dimension == 2 else 3,
            fixed=fixed,
            certificate=certificate,
        )

    final = solved(setup.poses(last.point))
    for _ in range(READMISSIONS if objective == "full" and setup.weights.definite else 0):
        chi2 = chi2_by_information(graph, final.world_from_cam)
        whole = final.component[graph.edges[:, 0]] == final.component[graph.edges[:, 1]]
        back = setup.weights.used & (weights == 0) & whole & (chi2 <= limit)
        if not back.any():
            break
        weights = np.where(back, share, weights)
        final = solved(final.world_from_cam)
    kept = np.flatnonzero(weights)
    notes = (
        *unheld,
        *(note for note in setup.weights.notes if note not in final.notes),
        f"{len(kept)} of {graph.edge_count} edges kept; short cycles test {tested} of them all",
        *final.notes,
    )
    metrics = {**final.metrics, "kept_edges": float(len(kept)), "tested_edges": float(tested)}
    return _with_confirmation(graph, replace(final, weights=weights, notes=notes, metrics=metrics), setup)


def _with_confirmation(graph: ViewGraph, solution: Solution, setup: Setup) -> Solution:
    """The solution with `confirmed` set: whether cycles of its used edges close better than by chance."""
    left_out = int((setup.weights.used & (solution.weights == 0)).sum())
    if confirmed(graph, np.flatnonzero(solution.weights)):
        return replace(solution, confirmed=True)
    if left_out:
        why = f"{left_out} edges are left out, and the cycles of the others close no better than by chance"
        note = f"{why}: nothing confirms the poses"
        return replace(solution, confirmed=False, notes=(note, *solution.notes))
    note = "no edge is left out, and no cycles close better than by chance: nothing tests the edges"
    return replace(solution, notes=(*solution.notes, note))


def _corruption(graph: ViewGraph, setup: Setup, limit: float) -> Floats:
    """How bad the used edges are by their short cycles, from 0 to 1; NaN where none tests one."""
    rows = np.flatnonzero(setup.weights.used)
    variances = 0.5 / setup.problem.kappa, 1 / setup.problem.tau
    return edge_corruption(short_loops(graph.edges[rows], graph.i_from_j[rows], *variances, limit), len(rows))


def _trust(corruption: Floats, spread: float) -> Floats:
    """The weights to begin with."""
    weights = np.exp(-((np.nan_to_num(corruption) / spread) ** 2))
    return np.where(np.isnan(corruption), UNTESTED_WEIGHT, weights)


@dataclass(frozen=True)
class _Search:
    """Rounds of weighted solves: a used edge weighs `confidence (used edges,)` of its information at the most, and its
    χ² with all of it is held against the limit.
    """

    setup: Setup
    judge: _Judge
    confidence: Floats
    limit: float
    kernel: Kernel

    def ends(self, trust: Floats) -> list[_Round]:
        """Where the rounds lead from the edges trusted first.

        The smooth kernel seldom loses right edges, but keeps more of the wrong ones: so its end, truncated, is tried
        too.
        """
        start = self._solved(trust, None)
        smooth = self._graduate(trust, start, "geman_mcclure")
        if self.kernel == "geman_mcclure":
            return [smooth]
        return [self._graduate(trust, start, self.kernel), self._truncated_after(smooth)]

    def truncated_cost(self, point: Point) -> float:
        """The cost of the edges, none more than the limit."""
        return float(self.confidence @ np.minimum(self.judge.chi2(point), self.limit))

    def _truncated_after(self, smooth: _Round) -> _Round:
        """The end of rounds with weights 0 and 1 from there."""
        weights, point = smooth.weights, smooth.point
        for _ in range(MAX_ROUNDS):
            new = _truncated(self.judge.chi2(point), self.limit, math.inf)
            if np.array_equal(new, weights):
                break
            weights, point = new, self._solved(new, point)
        return _Round(point, weights)

    def _graduate(self, trust: Floats, point: Point, kernel: Kernel) -> _Round:
        """Rounds of weighted solves in which the kernel goes from convex to its final shape."""
        limit, squares = self.limit, self.judge.chi2(point)
        seen = np.average(squares, weights=np.maximum(trust, WEIGHT_FLOOR)) if len(squares) else 0.0
        worst = float(max(np.max(squares[trust > KEPT_FROM], initial=0.0), seen))
        control = limit / (2 * worst - limit) if worst > limit else math.inf
        if kernel == "geman_mcclure":
            control = max(2 * worst / limit, 1.0)
        weights = trust
        for _ in range(MAX_ROUNDS):
            shape = _truncated if kernel == "truncated" else _geman_mcclure
            new = shape(squares, limit, control)
            point = self._solved(new, point)
            squares = self.judge.chi2(point)
            settled = np.abs(new - weights).max(initial=0.0) < SETTLED[kernel]
            weights = new
            if kernel == "truncated":
                control *= STEP
                if settled and bool(((weights < 1e-3) | (weights > 1 - 1e-3)).all()):
                    break
            else:
                if settled and control <= 1.0:
                    break
                control = max(control / STEP, 1.0)
        return _Round(point, weights)

    def _solved(self, weights: Floats, point: Point | None) -> Point:
        """The point that some Newton steps with these weights lead to; the first are from the chordal rotations."""
        problem = self.setup.problem
        held = self.confidence * np.maximum(weights, WEIGHT_FLOOR)
        weighted = replace(self.setup, problem=replace(problem, kappa=held * problem.kappa, tau=held * problem.tau))
        begin = weighted.initial("chordal") if point is None else (point.rotations, point.translations)
        limits = Limits(FIRST_STEPS, 1e-3) if point is None else Limits(STEPS_EACH, 1e-6)
        return descend_isotropic(weighted.problem, begin, limits, weighted.rounding).point


def _truncated(squares: Floats, limit: float, control: float) -> Floats:
    """Weights of the truncated least squares (Yang et al., equation 14)."""
    if math.isinf(control):
        return (squares <= limit).astype(float)
    middle = np.sqrt(limit * control * (control + 1) / np.maximum(squares, 1e-300)) - control
    return np.clip(middle, 0.0, 1.0)


def _geman_mcclure(squares: Floats, limit: float, control: float) -> Floats:
    """Weights of the Geman–McClure kernel (Yang et al., equation 12)."""
    return np.asarray((control * limit / (squares + control * limit)) ** 2)


@dataclass(frozen=True)
class _Judge:
    """The χ² of used edges, the same for one written the other way round: `graph` holds them alone."""

    setup: Setup
    graph: ViewGraph
    rotation_variance: Floats
    translation_variance: Floats

    @classmethod
    def of(cls, graph: ViewGraph, setup: Setup) -> _Judge:
        """The judge of a graph's used edges."""
        used = graph.select(np.flatnonzero(setup.weights.used))
        return cls(setup, used, *mean_variances(used, setup.dimension == 2))

    def chi2(self, point: Point) -> Floats:
        """χ² (used edges,) at a point, in the mean variances of an axis."""
        left = left_over(self.graph, self.setup.poses(point))
        turned, shifted = squares_at_both_ends(self.graph.i_from_j, left)
        return np.asarray(turned / self.rotation_variance + shifted / self.translation_variance)


@stage(frozen=True, config=ConfigDict(extra="forbid"))
class RobustSolver:
    """Maximum-likelihood poses of the edges that agree with each other."""

    kernel: Kernel = Field(
        "truncated", description="truncated: an edge counts or it does not; geman_mcclure: smooth weights"
    )
    threshold: float | None = Field(
        None, gt=0, description="χ² above which an edge is wrong; the default is the 99 % quantile of right edges"
    )
    objective: ObjectiveName = Field(
        "full", description="what the edges that are kept are solved with, as in `maximum_likelihood`"
    )
    trust: str = Field(
        AUTO, min_length=1, description="edges that are trusted as a backbone, as in the section `diagnosis`"
    )

    def solve(self, graph: ViewGraph, world_from_cam: Floats) -> Solution:
        """The poses; the first vertex of each component of all edges keeps its start pose."""
        return solve_robust(
            graph,
            start=world_from_cam,
            kernel=self.kernel,
            threshold=self.threshold,
            objective=self.objective,
            trust=self.trust,
        )
