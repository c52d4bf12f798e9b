"""Which candidate is kept: that of the lowest cost, but the input unless the other is clearly better."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hodge_pipeline.evaluation.difference import alike
from hodge_pipeline.evaluation.scores import SIGMA_M
from hodge_pipeline.evaluation.trajectory import absolute_error
from hodge_pipeline.refine.candidates import CandidateSet
from hodge_pipeline.refine.guard import SCORE_TOLERANCE, Measure
from hodge_pipeline.refine.reprojection_cost import ENOUGH_SEEN, FINEST_PX, best, degrees_of_freedom, mends
from hodge_pipeline.refine.uncertainty import told_apart
from hodge_pipeline.stages import Step, Steps
from hodge_pipeline.types import Floats
from hodge_pipeline.types.tracked_model import Adjusted, TrackedModel

LEAST_GAIN = 0.01
"""Share of the cost per degree of freedom that must be saved: a lens model that fits badly causes gains below it."""
CLEAR_GAIN = 0.5
"""Share of the cost beyond which a gain needs no further test: no way to weigh observations saves as much."""
LONG_TRACKS = 3.0
"""Mean images of a point. A point takes 3 of the 2 n numbers of n images: with fewer, poses can fit the rest."""
LEAST_MOVE, GAIN_TO_MOVE = 1e-3, 0.2
"""Poses that move by more than the first, as a share of the cameras' extent, need the second as a gain: a lens model
that fits badly moves them by as much and gains a few per cent. It mends no observations without spoiling as many, so a
candidate that `mends` needs no gain: a few observations weigh little in a mean."""
MERGE_LOSS = 0.05
"""Share by which the cost may grow where further measurements fit better: merged points leave fewer free parameters."""
MERGED_MORE = 1.25
"""Times the points that merge at the input's own poses: a candidate that merges more shows that matches contradict
these poses."""
UNTOLD = "tracks fix the poses less well than the best candidate moves them"
"""Why a candidate is refused whose poses move by less than its tracks leave open: what was given may be nearer to the
truth, as of 24 images and 120 points in two of them each: 1.8 to 4.6 % off, while the error falls to 0.03 px."""
OBSERVATIONS_HELD_OUT = 0.1
"""Share of the observations."""


@dataclass(frozen=True)
class Choice:
    """The row of the candidate that is kept, and why the input should be; "" where the candidate is better.

    `refused`: why it is not the candidate that costs least.
    """

    row: int
    reason: str
    refused: str = ""


def choose(found: CandidateSet, distances_m: Floats, seed: int, steps: Steps, *, force: bool = False) -> Choice:
    """The candidate to keep, by its cost and by the cloud distances (K, H) of the pairs with depth held out, metres.

    With `force` the input is kept only where there is nothing else.
    """
    merging = _merges_more(found)
    at = _best(found, merging, distances_m)
    reason = "" if at else "no candidate costs less"
    if at and not merging[at] and _depth_sign(distances_m, 0, at) <= 0 and not _nears_positions(found, 0, at):
        reason = _reason_to_keep(found, at, seed, steps)
    held, refused = found.best_held, reason
    if reason and held and not (held == at or _reason_to_keep(found, held, seed, steps)):
        at, reason = held, ""
    if not reason:
        return Choice(at, "", refused)
    if not force or len(found.costs) == 1:
        return Choice(0, reason, refused)
    return Choice(min(range(1, len(found.costs)), key=lambda row: found.costs[row].px), reason)


def _best(found: CandidateSet, merging: Sequence[bool], distances_m: Floats) -> int:
    """The row of the lowest cost among those that fit the depth held out no worse than the input.

    A cost up to `MERGE_LOSS` higher wins where further measurements fit better: merged matches, depth, positions.
    """
    rows = [row for row in range(len(found.costs)) if _depth_sign(distances_m, 0, row) >= 0]
    at = rows[best([found.costs[row] for row in rows])]
    for row in rows:
        if _cost_per_freedom(found, row) > (1 + MERGE_LOSS) * _cost_per_freedom(found, at):
            continue
        if merging[row] > merging[at] or _depth_sign(distances_m, at, row) > 0 or _nears_positions(found, at, row):
            at = row
    return at


def refused_doubt(found: CandidateSet, choice: Choice, distances_m: Floats) -> str:
    """Why kept poses are in doubt: a candidate that fits depth as well has half of their cost; "" where none has."""
    at, kept = _best(found, _merges_more(found), distances_m), found.px(choice.row)
    if at == choice.row or not found.candidates[choice.row].holds_poses or kept < FINEST_PX:
        return ""
    if not _gain(found, at) >= CLEAR_GAIN:
        return ""
    error = " → ".join(alike(kept, found.costs[at].px, 3))
    told = f", but {UNTOLD}" if choice.refused == UNTOLD != choice.reason else ""
    return f"in doubt, since {found.candidates[at].name} fits much better ({error} px){told}"


def _gain(found: CandidateSet, at: int) -> float:
    """The share of its reference's cost that a candidate saves, per degree of freedom."""
    return 1.0 - _cost_per_freedom(found, at) / _cost_per_freedom(found, _reference(found, at))


def _reference(found: CandidateSet, at: int) -> int:
    """The row that a candidate must be better than: the input; for one that moves poses, the best that holds them."""
    return 0 if found.candidates[at].holds_poses else found.best_held


def _cost_per_freedom(found: CandidateSet, row: int) -> float:
    """The cost times √(n / (n − p)), n numbers observed and p fitted: without it more points fit their own noise.

    Infinite where n ≤ p. The input's poses are none of the fitted parameters.
    """
    one = found.candidates[row]
    model, cost = one.model, found.costs[row]
    left = degrees_of_freedom(model, with_poses=not one.holds_poses)
    return cost.px * float(np.sqrt(2 * len(model.quality.errors_px) / left)) if left > 0 else float("inf")


def _nears_positions(found: CandidateSet, before: int, after: int) -> bool:
    """Whether a candidate is nearer to the known positions than another by more than fitting their noise gains."""
    off_m = found.position_errors_m
    return bool(off_m[after] < (1 - GAIN_TO_MOVE) * off_m[before])


def _depth_sign(distances_m: Floats, before: int, after: int) -> int:
    """1 where row `after` of the distances (K, H) is clearly better than row `before`, −1 where worse, else 0."""
    if not np.isfinite(distances_m[[before, after]]).all(axis=0).any():
        return 0
    score = held_out_score(distances_m[[before, after]])
    return int(score.is_better) - int(score.is_worse)


def _merges_more(found: CandidateSet) -> Sequence[bool]:
    """For each candidate whether it merges far more matched points than the input's poses allow."""
    models = [candidate.model for candidate in found.candidates]
    points = models[0].quality.points
    fewer = [points - model.quality.points for model in models]
    possible = points - models[0].merged().quality.points if any(fewer) else 0
    return [count > MERGED_MORE * possible for count in fewer]


def _reason_to_keep(found: CandidateSet, at: int, seed: int, steps: Steps) -> str:
    """Why the candidate's reference is kept in spite of its cost; "" where the candidate is clearly better."""
    reference = _reference(found, at)
    before, after = found.costs[reference], found.costs[at]
    start, model = found.candidates[reference].model, found.candidates[at].model
    if before.px < FINEST_PX:
        return f"observations fit to {before.px:.2g} px, better than any keypoint is located"
    if after.doubt:
        return "no candidate fits the tracks: mend matches or cameras (--refine focal), or --force the best one"
    is_mended, gain = mends(before, after), _gain(found, at)
    if not is_mended and not gain >= LEAST_GAIN:
        fitted = f"{' → '.join(alike(before.px, after.px, 4))} px"
        return f"the best candidate's gain ({fitted}) is what so many poses gain by fitting noise"
    moves = not found.candidates[at].holds_poses
    poses_alone = moves and not start.moves_calibration
    by_tracks = start.known_positions is None and not found.depth.graph.edge_count
    if poses_alone and by_tracks and not told_apart(found.candidates[0].model, model):
        return UNTOLD
    if is_mended:
        return ""
    if gain >= CLEAR_GAIN and start.quality.mean_track_length >= LONG_TRACKS:
        return ""
    moved = absolute_error(model.world_from_body, start.world_from_body, with_scale=True).rmse_m
    extent = float(np.linalg.norm(np.ptp(start.world_from_body[:, :3, 3], axis=0)))
    share = moved / extent if extent > 0 else 0.0
    if share > LEAST_MOVE and gain < GAIN_TO_MOVE and not start.moves_calibration:
        return f"the best candidate gains {gain:.1%} of the mean error and moves cameras by {share:.2%} of their extent"
    errors = steps.step(held_out_errors_px, start, model, moves, seed, title="observations held out")
    if not errors.size and gain < CLEAR_GAIN and model.quality.points == start.quality.points:
        return (
            f"the best candidate gains {gain:.1%} of the mean error, and tracks are too short to hold any of them out"
        )
    if not errors.size:
        return ""
    medians, capped = np.median(errors, axis=1), np.minimum(errors, after.cap_px).mean(axis=1)
    if medians[1] < medians[0] and capped[1] < capped[0]:
        return ""
    return f"observations held out are {medians[0]:.4g} px off, {medians[1]:.4g} px after the best candidate"


def held_out_errors_px(start: TrackedModel, model: TrackedModel, moves: bool, seed: int, *, step: Step) -> Floats:
    """Step: errors (2, H) of start and candidate at random observations that were left out of the adjustment: where the
    candidate `moves` poses, of the start of its points alone and of the candidate of points and poses; else of the
    start as it is and of the candidate of its points. Of tracks of which each image sees `ENOUGH_SEEN`. None (2, 0)
    where merged tracks make the observations incomparable.
    """
    adjusted: tuple[Adjusted, Adjusted] = ("points", "all") if moves else ("nothing", "points")
    out = []
    for whole, what in zip((start, model), adjusted, strict=True):
        one = whole.thinned(ENOUGH_SEEN)
        chosen = np.random.default_rng(seed).random(len(one.quality.errors_px)) < OBSERVATIONS_HELD_OUT
        out.append(one.held_out_errors(chosen, what))
    return np.array(out) if len(out[0]) == len(out[1]) else np.zeros((2, 0))


def held_out_score(distances_m: Floats) -> Measure:
    """The mean score exp(−d/σ) of pairs held out by their distances (2, H), before and after.

    Its tolerance is two standard errors of the mean of their differences.
    """
    scores = np.exp(-distances_m / SIGMA_M)
    scores = scores[:, np.isfinite(scores).all(axis=0)]
    count = scores.shape[1]
    noise = 2 * float((scores[1] - scores[0]).std()) / np.sqrt(max(count, 1))
    before, after = scores.mean(axis=1) if count else (np.nan, np.nan)
    name = f"cloud-to-cloud score of {count} held-out pairs"
    return Measure(name, float(before), float(after), "higher", max(noise, SCORE_TOLERANCE))
