"""The solution that most edges agree with, and the probability that each edge is right, given that solution."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hodge_pipeline.complex.series import series_classes
from hodge_pipeline.diagnosis.evidence import Evidence
from hodge_pipeline.diagnosis.growth import Alignment, align
from hodge_pipeline.diagnosis.mending import mend
from hodge_pipeline.diagnosis.rearrange import best_arrangement
from hodge_pipeline.diagnosis.robust_poses import ANNEALED, GATE, LARGE, TWICE, Fit, fit
from hodge_pipeline.solvers.maximum_likelihood import solve
from hodge_pipeline.types import Floats

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


def find_consensus(evidence: Evidence) -> tuple[Fit, Floats]:
    """The solution that most edges agree with, and the probability (E,) that each edge is right, given it."""
    grown = align(evidence)
    best = best_arrangement(evidence, fit(evidence, grown, TWICE)) if evidence.exhaustive else _mended(evidence, grown)
    best = _one_of_each_series(best, evidence)
    agreeing = np.sqrt(np.maximum(0.0, 1 - best.chi2 / GATE))
    return best, _unvouched(_with_prior(agreeing, evidence.prior), best, evidence)


def _one_of_each_series(best: Fit, evidence: Evidence) -> Fit:
    """The solution in which, of edges that exactly the same cycles pass, the one of the largest χ² alone is left out:
    nothing tests the others without it, and without two of them a piece would come off.
    """
    classes = series_classes(evidence.graph.edges, evidence.graph.vertex_count)
    out = np.flatnonzero(~best.used & (classes >= 0))
    out = out[np.lexsort((-best.chi2[out], classes[out]))]
    spared = out[1:][np.diff(classes[out]) == 0]
    chi2, used = best.chi2.copy(), best.used.copy()
    chi2[spared], used[spared] = 0.0, True
    return replace(best, chi2=chi2, used=used)


def _mended(evidence: Evidence, grown: Alignment) -> Fit:
    """The solution that grown pieces lead to where the order tells nothing of pairs that were tried."""
    graph, best = evidence.graph, _regrown(evidence, fit(evidence, grown, ANNEALED, rough=True))
    if 0 < (~best.used).sum() <= FEW * len(best.used):
        # where nearly all edges are right, none of them is left behind by a piece that drifted while it grew
        found = solve(graph, objective="isotropic", max_iterations=STEPS)
        of_all = Alignment(found.component, found.world_from_cam)
        best = max(best, fit(evidence, of_all, ANNEALED, rough=True), key=_used)
    best = fit(evidence, best, (GATE,))
    if graph.edge_count > LARGE:  # one exact solve is all that there is time for
        return best
    if not best.used.all() and graph.vertex_count <= SMALL:
        # an error that is spread over a loop in annealing can put all of its edges out of use
        best = max(best, fit(evidence, grown, TWICE), key=_used)
    return mend(evidence, best)


def _used(found: Fit) -> int:
    return int(found.used.sum())


def _regrown(evidence: Evidence, best: Fit) -> Fit:
    """The solution whose pieces, as the edges hold them, no longer grow into any that more edges agree on."""
    worth = WORTH * len(evidence.graph.edges)
    for _ in range(MOST_GROWTHS):
        ends = best.piece[evidence.graph.edges]
        if (ends[:, 0] != ends[:, 1]).sum() < worth:
            break
        found = fit(evidence, align(evidence, best), ANNEALED, rough=True)
        won = _used(found) - _used(best)
        best = found if won > 0 else best
        if won < worth:
            break
    return best


def _unvouched(probability: Floats, fit: Fit, evidence: Evidence) -> Floats:
    """The probabilities, no larger than the prior for a used edge that is the only connection between two parts which
    edges left out connect otherwise: no cycle of edges that agree confirms it.
    """
    bridge = fit.bridge & ~evidence.in_no_listed_cycle
    return np.where(bridge, np.minimum(probability, UNVOUCHED * evidence.prior), probability)


def _with_prior(agreeing: Floats, prior: Floats) -> Floats:
    clipped = np.clip(agreeing, EXTREME, 1 - EXTREME)
    logit = np.log(clipped / (1 - clipped)) + PRIOR_SHARE * np.log(prior / (1 - prior))
    return np.asarray(1 / (1 + np.exp(-logit)))
