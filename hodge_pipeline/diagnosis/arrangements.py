"""The best of several arrangements of a scene in which every pair was tried.

Growing pieces best first can take a place for another that looks like it, and from there no single move leads back. So
a second start uses only the edges between consecutive views, which are wrong more rarely. Of all arrangements on the
way the one with the largest log-evidence is taken. Its pieces then grow into one another wherever edges agree on it:
what keeps two pieces apart is no evidence on where they lie.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hodge_pipeline.diagnosis.arrangement_evidence import arrangement_log_evidence
from hodge_pipeline.diagnosis.evidence import Evidence
from hodge_pipeline.diagnosis.pieces import Alignment, align
from hodge_pipeline.diagnosis.rearrange import rearranged
from hodge_pipeline.diagnosis.robust_poses import ONCE, TWICE, Fit, fit
from hodge_pipeline.diagnosis.scene_model import learn_scene_model
from hodge_pipeline.types import Floats, ViewGraph

LARGEST = 150
"""Views: with more, all pairs of them would cost too much."""


def best_arrangement(
    evidence: Evidence, graph: ViewGraph, start: Fit, weight: Floats, cluster_gain: float, rng: np.random.Generator
) -> Fit:
    """The arrangement with the largest log-evidence, from `start` and, where it is informative, the order.

    `start` itself where there are too many views. `graph` has the recentred edges, `weight (E,)` the weight of each.
    """
    if not 2 < evidence.vertex_count <= LARGEST:
        return start
    starts = [start]
    if np.ptp(evidence.prior) > 0:
        starts.append(_in_order(evidence, graph, weight, cluster_gain, rng))
    found = [one for begun in starts for one in rearranged(evidence, graph, begun)]
    models = [learn_scene_model(evidence, found[0]), learn_scene_model(evidence, found[-1])]
    values = [arrangement_log_evidence(evidence, one.poses, one.component, models) for one in found]
    best = found[int(np.argmax(values))]
    grown = align(evidence, weight, cluster_gain, rng, Alignment(best.component, best.poses))
    return fit(evidence, graph, grown, ONCE)


def _in_order(
    evidence: Evidence, graph: ViewGraph, weight: Floats, cluster_gain: float, rng: np.random.Generator
) -> Fit:
    """The views chained by edges between consecutive ones, and then all edges that agree with that."""
    rows = np.flatnonzero(np.abs(evidence.edges[:, 1] - evidence.edges[:, 0]) == 1)
    chain = replace(
        evidence,
        edges=evidence.edges[rows],
        i_from_j=evidence.i_from_j[rows],
        prior=evidence.prior[rows],
        noise=evidence.noise.select(rows),
        support=evidence.support[rows],
        in_no_listed_cycle=evidence.in_no_listed_cycle[rows],
    )
    chained = fit(chain, graph.select(rows), align(chain, weight[rows], cluster_gain, rng), ONCE)
    return fit(evidence, graph, Alignment(chained.component, chained.poses), TWICE)
