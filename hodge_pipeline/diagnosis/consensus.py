"""The solution that most edges agree with, and the probability that each edge is right, given that solution."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hodge_pipeline.diagnosis.arrangements import best_arrangement
from hodge_pipeline.diagnosis.evidence import Evidence
from hodge_pipeline.diagnosis.mending import mend
from hodge_pipeline.diagnosis.options import DiagnosisOptions
from hodge_pipeline.diagnosis.pieces import Alignment, align
from hodge_pipeline.diagnosis.robust_poses import GATE, LARGE, TWICE, Fit, fit, rough_fit
from hodge_pipeline.solvers.maximum_likelihood import solve
from hodge_pipeline.types import Floats, ViewGraph

PRIOR_SHARE = 0.25
"""Of the prior's log odds. The probability, its root of 1 - chi2 / gate among it, was chosen for calibration: of right
edges of 90 simulated rings, corridors and streets and 16 rooms, and of nine graphs of real fragments.
"""
EXTREME = 0.01
UNVOUCHED = 0.9
STEPS = 3
"""Of Newton's, where the robust solution goes on from there."""
MOST_GROWTHS, WORTH = 3, 1e-3
"""Times that pieces grow again, while more than this share of the edges is to be won by it."""
FEW = 0.01
"""With no more than this share of its edges left out, a graph may be right as it is."""
SMALL = 3000
"""Vertices, up to which another solve costs little."""


@dataclass(frozen=True)
class Consensus:
    """The solution, and the probability (E,) that each edge is right."""

    fit: Fit
    probability: Floats


def find_consensus(evidence: Evidence, graph: ViewGraph, options: DiagnosisOptions) -> Consensus:
    """The alignment with the largest log-evidence; `graph` holds the recentred edges with their noise."""
    rng = np.random.default_rng(options.seed)
    weight = edge_weight(evidence)
    grown = align(evidence, weight, options.cluster_gain, rng)
    if evidence.exhaustive:
        best = best_arrangement(evidence, graph, fit(evidence, graph, grown, TWICE), weight, options.cluster_gain, rng)
    else:
        best = _regrown(evidence, graph, rough_fit(evidence, graph, grown), weight, options.cluster_gain, rng)
        if 0 < (~best.used).sum() <= FEW * len(best.used):
            best = max(best, _of_all(evidence, graph), key=_used)
        if graph.edge_count > LARGE:  # one exact solve is all that there is time for
            best = mend(evidence, graph, best)
            best = fit(evidence, graph, Alignment(best.component, best.poses), (GATE,))
        else:
            best = fit(evidence, graph, Alignment(best.component, best.poses), (GATE,))
            if not best.used.all() and graph.vertex_count <= SMALL:
                # an error that is spread over a loop in annealing can put all of its edges out of use
                best = max(best, fit(evidence, graph, grown, TWICE), key=_used)
            best = mend(evidence, graph, best)
    agreeing = np.sqrt(np.maximum(0.0, 1 - best.chi2 / GATE))
    return Consensus(best, _unvouched(_with_prior(agreeing, evidence.prior), best, evidence))


def _used(found: Fit) -> int:
    return int(found.used.sum())


def _regrown(
    evidence: Evidence, graph: ViewGraph, best: Fit, weight: Floats, cluster_gain: float, rng: np.random.Generator
) -> Fit:
    """The solution whose pieces, as the edges hold them, no longer grow into any that more edges agree on."""
    worth = WORTH * len(evidence.edges)
    for _ in range(MOST_GROWTHS):
        ends = best.component[evidence.edges]
        if (ends[:, 0] != ends[:, 1]).sum() < worth:
            break
        grown = align(evidence, weight, cluster_gain, rng, Alignment(best.component, best.poses))
        found = rough_fit(evidence, graph, grown)
        won = found.used.sum() - best.used.sum()
        best = found if won > 0 else best
        if won < worth:
            break
    return best


def _of_all(evidence: Evidence, graph: ViewGraph) -> Fit:
    """The solution that all edges lead to: where nearly all are right, none of them is left behind by a piece that
    drifted while it grew.
    """
    found = solve(graph, objective="isotropic", max_iterations=STEPS)
    return rough_fit(evidence, graph, Alignment(found.component, found.world_from_cam))


def _unvouched(probability: Floats, fit: Fit, evidence: Evidence) -> Floats:
    """The probabilities, no larger than the prior for a used edge that is the only connection between two parts which
    edges left out connect otherwise: no cycle of edges that agree confirms it.
    """
    bridge = fit.bridge & ~evidence.in_no_listed_cycle
    return np.where(bridge, np.minimum(probability, UNVOUCHED * evidence.prior), probability)


def edge_weight(evidence: Evidence) -> Floats:
    """The weight (E,) of an edge's vote: its odds by order, and half of that where no cycle closes over it."""
    odds = evidence.prior / (1 - evidence.prior)
    return np.asarray(odds * (0.5 + evidence.support) / (1 + evidence.support))


def _with_prior(agreeing: Floats, prior: Floats) -> Floats:
    clipped = np.clip(agreeing, EXTREME, 1 - EXTREME)
    logit = np.log(clipped / (1 - clipped)) + PRIOR_SHARE * np.log(prior / (1 - prior))
    return np.asarray(1 / (1 + np.exp(-logit)))
