"""The best of several arrangements of a scene in which every pair was tried.

Growing pieces best first can take a place for another that looks like it, and from there no single move leads back. So
a second start knows only the edges between consecutive views, which are wrong more rarely; and from both the views are
moved with two opinions on how many of the expected edges a placement must show. Of all arrangements on the way the one
of most worth is taken, and improved while that makes it worth more.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hodge_pipeline.diagnosis.evidence import Evidence
from hodge_pipeline.diagnosis.improve import improved
from hodge_pipeline.diagnosis.laws import learned
from hodge_pipeline.diagnosis.noise import Noise
from hodge_pipeline.diagnosis.pieces import Alignment, align
from hodge_pipeline.diagnosis.rearrange import rearranged
from hodge_pipeline.diagnosis.robust_poses import ONCE, TWICE, Fit, fit
from hodge_pipeline.diagnosis.worth import worth
from hodge_pipeline.types import Floats, ViewGraph

FAIR_SHARES = (0.75, 0.5)
LARGEST = 150
"""Views: with more, all pairs of them would cost too much."""


def best_arrangement(
    evidence: Evidence, graph: ViewGraph, start: Fit, weight: Floats, cluster_gain: float, rng: np.random.Generator
) -> Fit:
    """The arrangement that most speaks for, from `start` and from the order of the views where that tells.

    `start` itself where there are too many views. `graph` has the recentred edges, `weight` (E,) what each counts.
    """
    if not 2 < evidence.vertex_count <= LARGEST:
        return start
    starts = [start]
    if np.ptp(evidence.prior) > 0:
        starts.append(_in_order(evidence, graph, weight, cluster_gain, rng))
    found = [one for begun in starts for share in FAIR_SHARES for one in rearranged(evidence, graph, begun, share)]
    laws = [learned(evidence, found[0]), learned(evidence, found[-1])]
    values = [worth(evidence, one.poses, one.component, laws) for one in found]
    best = improved(evidence, graph, found[int(np.argmax(values))], FAIR_SHARES)
    return fit(evidence, graph, Alignment(best.component, best.poses), ONCE)


def _in_order(
    evidence: Evidence, graph: ViewGraph, weight: Floats, cluster_gain: float, rng: np.random.Generator
) -> Fit:
    """The views chained by edges between consecutive ones, and then all edges that agree with that."""
    rows = np.flatnonzero(np.abs(evidence.edges[:, 1] - evidence.edges[:, 0]) == 1)
    noise = Noise(evidence.noise.rotation_rad[rows], evidence.noise.translation_m[rows])
    chain = replace(
        evidence,
        edges=evidence.edges[rows],
        i_from_j=evidence.i_from_j[rows],
        prior=evidence.prior[rows],
        noise=noise,
        support=evidence.support[rows],
        alone=evidence.alone[rows],
    )
    chained = fit(chain, graph.select(rows), align(chain, weight[rows], cluster_gain, rng), ONCE)
    return fit(evidence, graph, Alignment(chained.component, chained.poses), TWICE)
