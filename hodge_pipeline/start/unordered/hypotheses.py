"""Refine matched pairs by ICP and reject those with little overlap, free-space violations or other colours."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from hodge_pipeline.registration.colour_evidence import hue_conflicts
from hodge_pipeline.registration.global_evidence import DepthView, violation
from hodge_pipeline.registration.global_pairs import Matches
from hodge_pipeline.registration.pairs import register_pairs
from hodge_pipeline.stages import Advance, Registrar, Workers, no_progress
from hodge_pipeline.start.unordered.options import HypothesisLimits
from hodge_pipeline.types import CloudSet, Edges, Floats, Ints
from hodge_pipeline.types.edges import REJECTED, USED

POINTS_PROJECTED = 1500
LEAD_SIGMAS = 2.0
"""Of the Poisson noise of a count: how far a motion's matches must exceed those of the best other motion."""
USUAL_VIOLATIONS = 8.0
USUAL_HUE_CONFLICTS = 12.0
ViewOf = Callable[[int], DepthView | None]


def weigh(
    folder: Path,
    matches: Matches,
    view_of: ViewOf,
    refine: Registrar,
    limits: HypothesisLimits,
    workers: Workers,
    advance: Advance = no_progress,
) -> Edges:
    """The matches (P,), those with enough inliers refined; what is good enough to be judged with the others counts.

    `folder` holds the clouds. `overlap` is the share of the smaller cloud near the other.

    A motion that hardly more matches explain than the best other one is refused: places look alike there, or what the
    clouds share lets them slide.
    """
    clouds = CloudSet.open(folder)
    edges = Edges.of(matches.pairs).put(slice(None), status=REJECTED, why="too few matches agree")
    enough = matches.inliers >= limits.min_inliers
    leads = matches.inliers - matches.rivals >= LEAD_SIGMAS * np.sqrt(matches.rivals)
    edges = edges.put(enough & ~leads, why="another motion explains as many matches")
    worth = np.flatnonzero(enough & leads)
    advance(len(edges) - len(worth))
    chosen = Edges.of(matches.pairs[worth])
    registered = register_pairs(folder, refine, chosen, matches.i_from_j[worth], workers, advance)
    sizes = clouds.sizes
    smaller = np.minimum(sizes[chosen.pairs[:, 0]], sizes[chosen.pairs[:, 1]])
    overlap = np.minimum(1.0, registered.fitness * sizes[chosen.pairs[:, 1]] / np.maximum(smaller, 1))
    seen_through = violations(clouds, chosen.pairs, registered.i_from_j, view_of, limits.room_m)
    reason = np.full(len(chosen), "", "U64")
    hue = hue_conflicts(clouds, chosen.pairs, registered.i_from_j)
    reason[hue > allowed_hue_conflict(hue, limits)] = "their colours differ"
    reason[seen_through > allowed_violation(seen_through, limits)] = "one camera saw through the other's surface"
    reason[~(registered.rmse_m <= limits.max_rmse_m)] = "points too far apart"
    reason[~(overlap >= limits.min_overlap)] = "too little overlap"
    status = np.where(reason == "", USED, REJECTED)
    return edges.put(worth, **vars(replace(registered, overlap=overlap, why=reason, status=status)))


def allowed_violation(seen_through: Floats, limits: HypothesisLimits) -> float:
    """The violation up to which a pair may be right, from those (P,) of a run, most of which are right."""
    known = seen_through[np.isfinite(seen_through)]
    usual = float(np.median(known)) if len(known) else 0.0
    return float(np.clip(USUAL_VIOLATIONS * usual, limits.violation_floor, limits.max_violation))


def allowed_hue_conflict(conflicts: Floats, limits: HypothesisLimits) -> float:
    """The hue conflict up to which a pair may be right, from those (P,) of a run, a quarter of which are right."""
    known = conflicts[np.isfinite(conflicts)]
    good = float(np.quantile(known, 0.25)) if len(known) else 0.0
    return max(USUAL_HUE_CONFLICTS * good, limits.hue_floor)


def violations(clouds: CloudSet, pairs: Ints, i_from_j: Floats, view_of: ViewOf, scale: float = 1.0) -> Floats:
    """The free-space violation (P,) of each pair, NaN where a frame has no depth image."""
    points = {row: _sampled(clouds, row) for row in np.unique(pairs).tolist()}
    out = np.full(len(pairs), np.nan)
    for at, ((i, j), motion) in enumerate(zip(pairs.tolist(), i_from_j, strict=True)):
        first, second = view_of(i), view_of(j)
        if first is not None and second is not None:
            out[at] = violation((first, second), (points[i], points[j]), motion, scale)
    return out


def _sampled(clouds: CloudSet, row: int) -> Floats:
    points = clouds[row].points_in_cam
    return np.asarray(points[:: max(1, len(points) // POINTS_PROJECTED)], float)
