"""Refine matched pairs by ICP and reject those with little overlap, free-space violations or other colours."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hodge_pipeline import se3
from hodge_pipeline.registration.acceptance import SEEN_THROUGH
from hodge_pipeline.registration.assessment import MOST_VIOLATION
from hodge_pipeline.registration.colour_evidence import hue_conflicts
from hodge_pipeline.registration.global_evidence import DepthView, violation
from hodge_pipeline.registration.global_pairs import Matches
from hodge_pipeline.registration.pairs import register_pairs
from hodge_pipeline.registration.sliding import may_slide
from hodge_pipeline.stages import Registrar, Workers
from hodge_pipeline.start.unordered.options import HypothesisLimits
from hodge_pipeline.types import Bools, CloudSet, Edges, Floats, Ints
from hodge_pipeline.types.edges import REJECTED, USED

POINTS_PROJECTED = 1500
"""By so many a share is known to 1.3 % or better (one standard error)."""
POINTS_KEPT = 256
"""Clouds whose points are in memory, 36 kB each."""
LEAD_SIGMAS = 2.0
"""By how many sigmas of Poisson noise the inliers of a motion must exceed those of its rival."""
ANOTHER_M, ANOTHER_RAD = 0.3, np.radians(10.0)
"""Metres in a room and radians from which two refined motions count as different: ICP converges over no more."""
LEAST_SPREAD = 0.025
"""Share of the information on translation in its weakest direction: wrong matches of a bare hill have 0.009 to 0.023,
streets 0.04 and more.
"""
RIVAL_OVERLAP, RIVAL_VIOLATION = 0.8, 2.0
"""Times the overlap, and the violation, of the best motion, for a rival to fit as well. In bare rooms a wrong motion,
turned by a half or a quarter, has 0.84 to 1.1 of the right overlap, since rings of a scanner fit each other; in
furnished ones it has 4 to 20 times the violation.
"""
AMBIGUOUS, NO_LEAD = "it fits in several ways", "another motion explains as many matches"
USUAL_TIMES = 12.0
"""Limit on violation and hue conflict, times the lower quartile of the run: at least a quarter is taken as right."""
LEAST_VIOLATION = 0.03
"""The share of the points in view that the other depth image may always have seen through."""
LEAST_HUE_CONFLICT = 0.02
"""Of the common points, whose hue may always differ."""
ViewOf = Callable[[int], DepthView | None]


def weigh(
    folder: Path,
    matches: Matches,
    view_of: ViewOf,
    refine: Registrar,
    limits: HypothesisLimits,
    workers: Workers,
) -> Edges:
    """A row for each matched pair: its best motion, refined by ICP, with status used where it may be an edge.

    `folder` holds the clouds. `overlap` is the share of the smaller cloud near the other. Of several motions of a pair
    each is refined and scored by the clouds; another that fits as well makes the pair ambiguous. A single motion is
    rejected where its inliers do not lead its rival's: places look alike, or surfaces slide.
    """
    clouds = CloudSet.open(folder)
    _, pair, motions = np.unique(matches.pairs, axis=0, return_inverse=True, return_counts=True)
    pair = pair.reshape(-1)
    leads = _leads(matches.inliers, matches.rivals)
    why = np.where(leads | (motions[pair] > 1), "", NO_LEAD).astype("U64")
    why[matches.inliers < limits.min_inliers] = "too few matches agree"
    worth = np.flatnonzero(why == "")
    chosen = Edges.of(matches.pairs[worth])
    registered = register_pairs(folder, refine, chosen, matches.i_from_j[worth], workers)
    evidence = _evidence(clouds, registered, view_of, limits)
    score = np.full(len(why), -np.inf)
    score[worth] = evidence.overlap - np.nan_to_num(evidence.seen_through)
    why[worth] = evidence.reasons(_best(pair[worth], score[worth]), limits)
    status = np.where(why == "", USED, REJECTED)
    edges = Edges.of(matches.pairs).put(worth, **vars(replace(registered, overlap=evidence.overlap)))
    edges = edges.put(slice(None), status=status, why=why)
    best = _best(pair, np.where(edges.counts, score + 2.0, score))
    seen_through = np.full(len(why), np.nan)
    seen_through[worth] = evidence.seen_through
    ambiguous = _ambiguous(edges, pair, best, seen_through, matches.inliers, limits)
    edges = edges.put(best[ambiguous], status=REJECTED, why=AMBIGUOUS)
    bare = edges.counts & ~_supported(edges, pair, best, leads, limits)
    return edges.put(bare, status=REJECTED, why=NO_LEAD).select(best)


def _leads(count: Ints, rival: Ints) -> Bools:
    """Where a motion has clearly more inliers than its rival."""
    return np.asarray(count - rival >= LEAD_SIGMAS * np.sqrt(rival))


@dataclass(frozen=True)
class _Evidence:
    """Evidence of the clouds on motions (P,): overlap; shares of free-space violations and of hue conflicts, NaN where
    unknown; RMS distance of common points in metres; whether a direction of translation is unconstrained.
    """

    overlap: Floats
    seen_through: Floats
    hue: Floats
    rmse_m: Floats
    slides: Bools

    def reasons(self, best: Ints, limits: HypothesisLimits) -> NDArray[np.str_]:
        """Why each motion is rejected, empty where it is not; limits are relative to the rows `best`."""
        out = np.full(len(self.hue), "", "U64")
        out[self.hue > allowed_hue_conflict(self.hue[best])] = "their colours differ"
        violated = self.seen_through > allowed_violation(self.seen_through[best])
        out[violated] = SEEN_THROUGH
        out[self.slides] = "what they share lets them slide"
        out[~(self.rmse_m <= limits.max_rmse_m)] = "points too far apart"
        out[~(self.overlap >= limits.min_overlap)] = "too little overlap"
        return out


def _evidence(clouds: CloudSet, registered: Edges, view_of: ViewOf, limits: HypothesisLimits) -> _Evidence:
    sizes, pairs = clouds.sizes, registered.pairs
    smaller = np.minimum(sizes[pairs[:, 0]], sizes[pairs[:, 1]])
    overlap = np.minimum(1.0, registered.fitness * sizes[pairs[:, 1]] / np.maximum(smaller, 1))
    seen_through = violations(clouds, pairs, registered.i_from_j, view_of, limits.room_m)
    hue = hue_conflicts(clouds, pairs, registered.i_from_j)
    return _Evidence(overlap, seen_through, hue, registered.rmse_m, may_slide(registered, LEAST_SPREAD))


def _best(pair: Ints, score: Floats) -> Ints:
    """The row of each pair (P,) with the highest score, the first of equals."""
    order = np.lexsort((np.arange(len(pair)), -score, pair))
    return np.asarray(order[np.unique(pair[order], return_index=True)[1]])


def _differs(edges: Edges, mine: Ints, limits: HypothesisLimits) -> Bools:
    """Which rows have another motion than the rows `mine` (P,)."""
    apart = se3.inverse(edges.i_from_j[mine]) @ edges.i_from_j
    far = np.linalg.norm(apart[:, :3, 3], axis=1) > ANOTHER_M * limits.room_m
    return np.asarray(far | (np.linalg.norm(se3.so3_log(apart[:, :3, :3]), axis=1) > ANOTHER_RAD))


def _supported(edges: Edges, pair: Ints, best: Ints, leads: Bools, limits: HypothesisLimits) -> Bools:
    """Rows of pairs where a motion that was refined to the best one had clearly more inliers than its rival."""
    same = ~_differs(edges, best[pair], limits) & (edges.correspondences > 0)
    return np.isin(pair, pair[same & leads])


def _ambiguous(
    edges: Edges, pair: Ints, best: Ints, seen_through: Floats, inliers: Ints, limits: HypothesisLimits
) -> Bools:
    """Which of the `best` rows have another motion of their pair that may be an edge and fits as well: by overlap and
    free space, or by inliers where free space is unknown.
    """
    mine = best[pair]
    fits = edges.overlap >= RIVAL_OVERLAP * edges.overlap[mine]
    known = np.isfinite(seen_through) & np.isfinite(seen_through[mine])
    as_free = seen_through <= np.maximum(RIVAL_VIOLATION * seen_through[mine], LEAST_VIOLATION)
    fits &= np.where(known, as_free, ~_leads(inliers[mine], inliers))
    return np.isin(pair[best], pair[edges.counts & edges.counts[mine] & _differs(edges, mine, limits) & fits])


def allowed_violation(seen_through: Floats) -> float:
    """The greatest violation of a right pair, from those (P,) of a run, assuming that a quarter are right."""
    return min(_allowed(seen_through, LEAST_VIOLATION), MOST_VIOLATION)


def allowed_hue_conflict(conflicts: Floats) -> float:
    """The greatest hue conflict of a right pair, from those (P,) of a run, assuming that a quarter are right."""
    return _allowed(conflicts, LEAST_HUE_CONFLICT)


def _allowed(shares: Floats, least: float) -> float:
    known = shares[np.isfinite(shares)]
    return max(USUAL_TIMES * float(np.quantile(known, 0.25)) if len(known) else 0.0, least)


def violations(clouds: CloudSet, pairs: Ints, i_from_j: Floats, view_of: ViewOf, scale: float) -> Floats:
    """The free-space violation (P,) of each pair, NaN where a frame has no depth image."""
    points_of = lru_cache(maxsize=POINTS_KEPT)(partial(_sampled, clouds))
    out = np.full(len(pairs), np.nan)
    for at, ((i, j), motion) in enumerate(zip(pairs.tolist(), i_from_j, strict=True)):
        first, second = view_of(i), view_of(j)
        if first is not None and second is not None:
            out[at] = violation((first, second), (points_of(i), points_of(j)), motion, scale)
    return out


def _sampled(clouds: CloudSet, row: int) -> Floats:
    points = clouds[row].points_in_cam
    return np.asarray(points[:: max(1, len(points) // POINTS_PROJECTED)], float)
