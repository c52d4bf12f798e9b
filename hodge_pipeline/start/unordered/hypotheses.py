"""Matches, refined and weighed: which of them are good enough for the diagnosis to judge."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hodge_pipeline.registration.colour_evidence import hue_conflicts
from hodge_pipeline.registration.global_evidence import DepthView, free_directions_of, violation
from hodge_pipeline.registration.global_pairs import Matches
from hodge_pipeline.registration.pairs import register_pairs
from hodge_pipeline.stages import Advance, Registrar, Workers, no_progress
from hodge_pipeline.start.unordered.options import HypothesisLimits
from hodge_pipeline.types import Bools, CloudSet, Edges, Floats, Ints, ViewGraph

POINTS_PROJECTED = 1500
USUAL_VIOLATIONS = 8.0
USUAL_HUE_CONFLICTS = 12.0
ViewOf = Callable[[int], DepthView | None]


@dataclass(frozen=True)
class Hypotheses:
    """Where one cloud may lie in another, with the evidence, in columns.

    - `pairs (P, 2)`, `inliers`, `matches (P,)`: of the features; 0 inliers where no motion was found.
    - `registered`: after refinement; rows of pairs that were not worth it hold the match itself.
    - `overlap (P,)`: share of the smaller cloud near the other; `violation (P,)`: the share of points in view that the
      other camera saw through, NaN where there are no depth images; `free (P,)`: motions that the common surfaces
      leave open, in words.
    - `reason (P,)`: why it is no edge, an empty word where it is one.
    """

    pairs: Ints
    inliers: Ints
    matches: Ints
    registered: Edges
    overlap: Floats
    violation: Floats
    free: NDArray[np.str_]
    reason: NDArray[np.str_]

    @property
    def accepted(self) -> Bools:
        """Where (P,) it is good enough to be judged with the others."""
        return np.asarray(self.reason == "")

    @property
    def counts(self) -> dict[str, int]:
        """How many were refused for each reason."""
        return dict(sorted(Counter(self.reason[self.reason != ""].tolist()).items()))

    def as_graph(self, vertex_ids: NDArray[np.generic], source: str) -> ViewGraph:
        """The accepted ones as a viewing graph."""
        return self.registered.select(self.accepted).put(slice(None), proposed_by=source).as_graph(vertex_ids)

    @classmethod
    def joined(cls, first: Hypotheses, second: Hypotheses) -> Hypotheses:
        """These columns one after the other."""
        columns = {
            field.name: np.concatenate([getattr(first, field.name), getattr(second, field.name)])
            for field in fields(cls)
            if field.name != "registered"
        }
        return cls(registered=Edges.joined([first.registered, second.registered]), **columns)


def weigh(
    folder: Path,
    matches: Matches,
    view_of: ViewOf,
    refine: Registrar,
    limits: HypothesisLimits,
    needs_all_directions: bool,
    workers: Workers,
    advance: Advance = no_progress,
) -> Hypotheses:
    """The matches with enough inliers refined, and all of them with their evidence; `folder` holds the clouds.

    `needs_all_directions`: whether a pair whose common surfaces leave a motion open is refused, as it must be where
    nothing but the surfaces joined it.
    """
    clouds = CloudSet.open(folder)
    worth = matches.inliers >= limits.min_inliers
    advance(int((~worth).sum()))
    chosen = matches.select(worth)
    registered = register_pairs(folder, refine, Edges.of(chosen.pairs), chosen.i_from_j, workers, advance)
    sizes = clouds.sizes
    smaller = np.minimum(sizes[chosen.pairs[:, 0]], sizes[chosen.pairs[:, 1]])
    overlap = np.minimum(1.0, registered.fitness * sizes[chosen.pairs[:, 1]] / np.maximum(smaller, 1))
    seen_through = violations(clouds, chosen.pairs, registered.i_from_j, view_of)
    frames = {row: _frame_of(clouds, row) for row in np.unique(chosen.pairs[:, 1]).tolist()}
    free = np.array(
        [
            "; ".join(free_directions_of(information, *frames[int(j)]))
            for information, j in zip(registered.information, chosen.pairs[:, 1], strict=True)
        ],
        dtype=np.str_,
    )
    reason = np.full(len(chosen), "", "U64")
    if needs_all_directions:
        reason[free != ""] = "what they share leaves a motion open"
    hue = hue_conflicts(clouds, chosen.pairs, registered.i_from_j)
    reason[hue > allowed_hue_conflict(hue, limits)] = "their colours differ"
    reason[seen_through > allowed_violation(seen_through, limits)] = "one camera saw through the other's surface"
    reason[~(registered.rmse_m <= limits.max_rmse_m)] = "points too far apart"
    reason[~(overlap >= limits.min_overlap)] = "too little overlap"
    return _with_unworthy(matches, worth, registered, overlap, seen_through, free, reason)


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


def _frame_of(clouds: CloudSet, row: int) -> tuple[Floats, float]:
    """Centroid and RMS radius of a cloud."""
    points = np.asarray(clouds[row].points_in_cam, float)
    middle = points.mean(axis=0)
    return middle, float(np.sqrt(((points - middle) ** 2).sum(axis=1).mean()))


def violations(clouds: CloudSet, pairs: Ints, i_from_j: Floats, view_of: ViewOf) -> Floats:
    """The free-space violation (P,) of each pair, NaN where a frame has no depth image."""
    points = {row: _sampled(clouds, row) for row in np.unique(pairs).tolist()}
    out = np.full(len(pairs), np.nan)
    for at, ((i, j), motion) in enumerate(zip(pairs.tolist(), i_from_j, strict=True)):
        first, second = view_of(i), view_of(j)
        if first is not None and second is not None:
            out[at] = violation((first, second), (points[i], points[j]), motion)
    return out


def _sampled(clouds: CloudSet, row: int) -> Floats:
    points = clouds[row].points_in_cam
    return np.asarray(points[:: max(1, len(points) // POINTS_PROJECTED)], float)


def _with_unworthy(
    matches: Matches,
    worth: Bools,
    registered: Edges,
    overlap: Floats,
    seen_through: Floats,
    free: NDArray[np.str_],
    reason: NDArray[np.str_],
) -> Hypotheses:
    order = np.argsort(np.concatenate([np.flatnonzero(worth), np.flatnonzero(~worth)]), kind="stable")
    rest = matches.select(~worth)
    count = len(rest)
    none = np.zeros((count, 6, 6))
    unrefined = replace(Edges.of(rest.pairs), i_from_j=rest.i_from_j, information=none, fitness=np.zeros(count))

    def column(values: NDArray[np.generic], other: object) -> NDArray[np.generic]:
        return np.concatenate([values, np.full(count, other)])[order]

    return Hypotheses(
        pairs=matches.pairs,
        inliers=matches.inliers,
        matches=matches.matches,
        registered=Edges.joined([registered, unrefined]).select(order),
        overlap=column(overlap, np.nan),  # type: ignore[arg-type]
        violation=column(seen_through, np.nan),  # type: ignore[arg-type]
        free=column(free, ""),  # type: ignore[arg-type]
        reason=column(reason, "too few matches agree"),  # type: ignore[arg-type]
    )
