"""How often each edge survives: the scene aligned many times from perturbed weights (perturb-and-MAP).

One best alignment hides how close the runner-up was. The share of runs in which an edge agrees with the rest is an
estimate of its probability that knows of whole rival explanations, such as two places that look alike.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hodge_pipeline.diagnosis.arrange import best_arrangement
from hodge_pipeline.diagnosis.evidence import Evidence
from hodge_pipeline.diagnosis.options import DiagnosisOptions
from hodge_pipeline.diagnosis.pieces import align
from hodge_pipeline.diagnosis.robust_poses import FIRST_GATE, GATE, Fit, fit
from hodge_pipeline.types import Floats, ViewGraph

FLOOR = 0.03
FINAL_PENALTY = 0.5
PRIOR_SHARE = 0.3
EXTREME = 0.01
UNVOUCHED = 0.9
FINAL_SHARE = 0.7
"""Of the final arrangement in the probability; the rest is how often the perturbed runs agree."""


@dataclass(frozen=True)
class Consensus:
    """The best solution, and the probability (E,) that each edge is right."""

    fit: Fit
    probability: Floats
    runs: int


def find_consensus(evidence: Evidence, graph: ViewGraph, options: DiagnosisOptions) -> Consensus:
    """The alignment that most runs speak for; `graph` holds the recentred edges with the information of their noise."""
    rng = np.random.default_rng(options.seed)
    weight = edge_weight(evidence)
    runs = int(np.clip(options.edges_budget // max(graph.edge_count, 1), 1, options.runs))
    share = np.zeros(graph.edge_count)
    for run in range(runs if runs > 1 else 0):
        penalty = options.overlap_penalties[run % len(options.overlap_penalties)]
        perturbed = weight * np.exp(options.perturbation * rng.normal(size=len(weight)))
        chi2 = fit(evidence, graph, align(evidence, perturbed, options.cluster_gain, penalty, rng), 1).chi2
        share += np.maximum(0.0, 1 - chi2 / FIRST_GATE) / runs
    voted = weight * (share + FLOOR) / (1 + FLOOR - share) if runs > 1 else weight
    leading = align(evidence, voted, options.cluster_gain, FINAL_PENALTY, rng)
    if evidence.exhaustive:
        best, agreeing = best_arrangement(evidence, graph, [leading])
    else:
        best = fit(evidence, graph, leading, 2)
        agreeing = np.maximum(0.0, 1 - best.chi2 / GATE)
    mean = FINAL_SHARE * agreeing + (1 - FINAL_SHARE) * share if runs > 1 else agreeing
    probability = _with_prior(mean, evidence.prior)
    return Consensus(best, _unvouched(probability, best, evidence), runs)


def _unvouched(probability: Floats, fit: Fit, evidence: Evidence) -> Floats:
    """An edge that alone holds two parts together, against edges that would hold them otherwise, is no more likely
    than its order makes it: no cycle of edges that agree vouches for it.
    """
    bridge = fit.used & np.isinf(fit.resistance) & ~evidence.alone
    return np.where(bridge, np.minimum(probability, UNVOUCHED * evidence.prior), probability)


def edge_weight(evidence: Evidence) -> Floats:
    """What an edge's own vote counts (E,): its odds by order, and half of that where no cycle closes over it."""
    odds = evidence.prior / (1 - evidence.prior)
    return np.asarray(odds * (0.5 + evidence.support) / (1 + evidence.support))


def _with_prior(mean: Floats, prior: Floats) -> Floats:
    clipped = np.clip(mean, EXTREME, 1 - EXTREME)
    logit = np.log(clipped / (1 - clipped)) + PRIOR_SHARE * np.log(prior / (1 - prior))
    return np.asarray(1 / (1 + np.exp(-logit)))
