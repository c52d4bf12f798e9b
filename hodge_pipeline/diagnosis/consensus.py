"""The solution that most edges agree with, and the probability that each edge is right, given that solution.

Greedy merging can mistake a place for another that looks like it, and no single move then leads back. So a second start
begins with the paths of consecutive views, which are wrong more rarely. Where every pair was tried, the local search
begins at both, and the solution with the larger log-evidence is taken. Elsewhere a third start begins with chordal
poses of all edges, from which edges beyond the gate are dropped.
"""

from __future__ import annotations

import numpy as np
from scipy.special import expit

from hodge_pipeline.complex.components import connected_components
from hodge_pipeline.diagnosis.evidence import Evidence
from hodge_pipeline.diagnosis.growth import Alignment, align
from hodge_pipeline.diagnosis.placement import arrangement_log_evidence
from hodge_pipeline.diagnosis.robust_poses import ANNEALED, GATE, LARGE, TWICE, Solved, fit
from hodge_pipeline.diagnosis.scene_model import learn_scene_model
from hodge_pipeline.diagnosis.search import LARGEST, searched
from hodge_pipeline.types import Floats

PRIOR_SHARE = 0.25
"""Share of the prior's log-odds in those of an edge. With it, and the root of 1 - chi2 / gate, probabilities are
calibrated on right edges of 90 simulated rings, corridors and streets and 16 rooms, and of nine graphs of real
fragments.
"""
EXTREME = 0.01
"""Least distance of a probability from 0 and 1, before the prior."""
EVERY = 1e9
"""A gate that lets every edge pass."""


def find_consensus(evidence: Evidence) -> Solved:
    """The solution that most edges agree with."""
    grown = align(evidence)
    if evidence.exhaustive:
        return best_arrangement(evidence, fit(evidence, grown, TWICE))
    return _mended(evidence, grown)


def agreeing(evidence: Evidence, found: Solved) -> Floats:
    """The probability (E,) that each edge is right, given the solution."""
    clipped = np.clip(np.sqrt(np.maximum(0.0, 1 - found.chi2 / GATE)), EXTREME, 1 - EXTREME)
    prior = evidence.prior
    logit = np.log(clipped / (1 - clipped)) + PRIOR_SHARE * np.log(prior / (1 - prior))
    return np.asarray(expit(logit))


def best_arrangement(evidence: Evidence, start: Solved) -> Solved:
    """The solution with the largest log-evidence, searched from `start` and from the paths of consecutive views;
    `start` itself where there are more than `LARGEST` views.
    """
    if not 2 < evidence.graph.vertex_count <= LARGEST:
        return start
    in_order = fit(evidence, _in_order(evidence), TWICE)
    starts = (start,) if np.array_equal(start.used, in_order.used) else (start, in_order)
    found = [searched(evidence, begun) for begun in starts]
    models = [learn_scene_model(evidence, one) for one in found]
    values = [sum(arrangement_log_evidence(evidence, one, model) for model in models) for one in found]
    return found[int(np.argmax(values))]


def _mended(evidence: Evidence, grown: Alignment) -> Solved:
    """The solution from grown pieces, and from other starts, where not every pair was tried."""
    graph, best = evidence.graph, fit(evidence, grown, ANNEALED)
    # a ring of many edges may wind once too often, a local minimum that chordal rotations avoid
    best = min((fit(evidence, best, (GATE,), initial=name) for name in ("given", "chordal")), key=_misfit)
    if graph.edge_count > LARGE:  # one exact solve is all that there is time for
        return best
    if not best.used.all():
        whole = Alignment(connected_components(graph.edges, graph.vertex_count), best.poses)
        for start in (_in_order(evidence), fit(evidence, whole, (EVERY,), "chordal")):
            best = min(best, fit(evidence, fit(evidence, start, ANNEALED), (GATE,)), key=_misfit)
    return searched(evidence, best)


def _in_order(evidence: Evidence) -> Alignment:
    """The alignment grown from the paths of consecutive edges: no cycle shows which edges are wrong where a chain hangs
    by one end and by wrong ones.
    """
    steps = np.abs(evidence.graph.edges[:, 1] - evidence.graph.edges[:, 0]) == 1
    return align(evidence, align(evidence, along=steps))


def _misfit(found: Solved) -> float:
    """The truncated χ² of all edges: each no more than the gate."""
    return float(np.minimum(found.chi2, GATE).sum())
