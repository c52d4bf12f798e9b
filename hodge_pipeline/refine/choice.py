"""Which candidate is kept: the lowest cost, and the input itself unless another one is clearly better."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hodge_pipeline.evaluation.difference import alike
from hodge_pipeline.evaluation.scores import SIGMA_M
from hodge_pipeline.evaluation.trajectory import absolute_error
from hodge_pipeline.refine.candidates import Found
from hodge_pipeline.refine.guard import Measure
from hodge_pipeline.refine.judge import best, mends
from hodge_pipeline.stages import Step, Steps, TrackedModel
from hodge_pipeline.types import Floats

FINEST_PX = 0.01
"""Mean error: no keypoint is located better, so less of it is no better model."""
LEAST_GAIN = 0.01
"""Of the cost per degree of freedom: less is what a lens that does not quite fit gives."""
CLEAR_GAIN = 0.5
"""Of the cost: half of it is more than any way to weigh observations; below it observations held out decide as well."""
LONG_TRACKS = 3.0
"""Images in the mean: points in fewer take more than half of the numbers, and poses can fit what is left over."""
LEAST_MOVE, GAIN_TO_MOVE = 1e-3, 0.2
"""Of the extent of the cameras: poses that move by more need a gain of a fifth, since a lens that does not quite fit
moves them by as much and gains a few per cent. It puts no image off by most of its observations: a candidate that mends
such images, and spoils none, needs no more than the least gain, since few of many weigh little in the mean."""
MERGE_LOSS = 0.05
"""Of the cost: so much more of it is the price of points that a match makes one."""
MERGED_MORE = 1.25
"""Times the points that the input's own poses allow to be merged: then the matches speak against those poses."""
HELD_OUT_SHARE = 0.1
"""Of the observations."""
SCORE_TOLERANCE = 0.002


@dataclass(frozen=True)
class Choice:
    """The row of the candidate that is kept, and why the input would be kept: empty where the candidate is better."""

    row: int
    reason: str


def choose(found: Found, distances_m: Floats, seed: int, steps: Steps, *, force: bool = False) -> Choice:
    """The candidate to keep, by its cost and by what each candidate makes of the pairs held out (K, H), metres.

    With `force` the best of those that are not the input.
    """
    merging = _merging(found)
    at = _best(found, merging, distances_m)
    reason = "" if at else "no candidate costs less"
    if at and not merging[at] and _by_depth(distances_m, 0, at) <= 0 and not _fits_positions(found, 0, at):
        reason = _reason_to_keep(found, at, seed, steps)
    if reason and found.held and not (at == found.held or _reason_to_keep(found, found.held, seed, steps)):
        at, reason = found.held, ""
    if not reason:
        return Choice(at, "")
    if not force or len(found.costs) == 1:
        return Choice(0, reason)
    return Choice(min(range(1, len(found.costs)), key=lambda row: found.costs[row].px), reason)


def _best(found: Found, merging: Sequence[bool], distances_m: Floats) -> int:
    """The lowest cost of those that fit the depth of pairs held out no worse than the input, or a little more where
    further measurements took part: points that matches merged, or depth or known positions that fit clearly better.
    """
    rows = [row for row in range(len(found.costs)) if _by_depth(distances_m, 0, row) >= 0]
    at = rows[best([found.costs[row] for row in rows])]
    for row in rows:
        if _per_freedom(found, row) > (1 + MERGE_LOSS) * _per_freedom(found, at):
            continue
        if merging[row] > merging[at] or _by_depth(distances_m, at, row) > 0 or _fits_positions(found, at, row):
            at = row
    return at


def refused_doubt(found: Found, choice: Choice, distances_m: Floats) -> str:
    """A doubt where the input is kept though a candidate, which depth does not refuse, leaves less than half of its
    cost.
    """
    at, kept = _best(found, _merging(found), distances_m), found.px(choice.row)
    if at == choice.row or not found.candidates[choice.row].holds_poses or kept < FINEST_PX:
        return ""
    if not _gain(found, at) >= CLEAR_GAIN:
        return ""
    error = " → ".join(alike(kept, found.costs[at].px, 3))
    return f"in doubt, since {found.candidates[at].name} fits much better ({error} px)"


def _gain(found: Found, at: int) -> float:
    """The share that a candidate saves of the cost that its reference has, each as it would be were nothing fitted."""
    return 1.0 - _per_freedom(found, at) / _per_freedom(found, _reference(found, at))


def _reference(found: Found, at: int) -> int:
    """What a candidate must be better than: the input, or, where it moves poses, the best with the input's poses."""
    return 0 if found.candidates[at].holds_poses else found.held


def _per_freedom(found: Found, row: int) -> float:
    """The cost as it would be were nothing fitted: fewer points have less to fit noise with. Infinite where nothing
    is left over. Poses of the input count as measured by other means.
    """
    model, cost = found.candidates[row].model, found.costs[row]
    numbers = 2.0 * len(model.quality.errors_px)
    left = numbers - 3.0 * model.quality.points
    if not found.candidates[row].holds_poses:
        left -= 6.0 * len(model.body_names)
    return cost.px * float(np.sqrt(numbers / left)) if left > 0 else float("inf")


def _fits_positions(found: Found, before: int, after: int) -> bool:
    """Whether a candidate is nearer to known positions by more than fitting their noise would bring it."""
    off = found.positions_off
    return bool(off[after] < (1 - GAIN_TO_MOVE) * off[before])


def _by_depth(distances_m: Floats, before: int, after: int) -> int:
    """1 where one candidate fits the pairs held out (K, H) clearly better than another, -1 where worse, else 0."""
    if not np.isfinite(distances_m[[before, after]]).all(axis=0).any():
        return 0
    score = held_out_score(distances_m[[before, after]])
    return int(score.is_better) - int(score.is_worse)


def _merging(found: Found) -> Sequence[bool]:
    """For each candidate whether it makes one of points that a match calls one, far more than the input's poses can."""
    models = [candidate.model for candidate in found.candidates]
    points = models[0].quality.points
    fewer = [points - model.quality.points for model in models]
    possible = points - models[0].merged().quality.points if any(fewer) else 0
    return [count > MERGED_MORE * possible for count in fewer]


def _reason_to_keep(found: Found, at: int, seed: int, steps: Steps) -> str:
    """Why the input, or its poses, are kept all the same; empty where the candidate is clearly better."""
    reference = _reference(found, at)
    before, after = found.costs[reference], found.costs[at]
    start, model = found.candidates[reference].model, found.candidates[at].model
    mending = mends(before, after)
    if before.px < FINEST_PX:
        return f"observations fit to {before.px:.2g} px, better than any keypoint is located"
    if after.doubt:
        return "no candidate fits the tracks: mend matches or cameras (--refine focal), or --force the best one"
    gain = _gain(found, at)
    if not (mending or gain >= LEAST_GAIN):
        fitted = f"{' → '.join(alike(before.px, after.px, 4))} px"
        return f"the best candidate's gain ({fitted}) is what so many poses gain by fitting noise"
    if mending or (gain >= CLEAR_GAIN and start.quality.mean_track_length >= LONG_TRACKS):
        return ""
    moved = absolute_error(model.world_from_body, start.world_from_body, with_scale=True).rmse_m
    extent = float(np.linalg.norm(np.ptp(start.world_from_body[:, :3, 3], axis=0)))
    share = moved / extent if extent > 0 else 0.0
    if share > LEAST_MOVE and gain < GAIN_TO_MOVE and not start.moves_intrinsics:
        return f"the best candidate gains {gain:.1%} of the mean error and moves cameras by {share:.2%} of their extent"
    moves = not found.candidates[at].holds_poses
    errors = steps.step(held_out_errors, start, model, seed, moves, title="observations held out").errors_px
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


@dataclass(frozen=True)
class HeldOutErrors:
    """Errors (2, H) in pixels of the observations held out, before and after."""

    errors_px: Floats


def held_out_errors(
    start: TrackedModel, model: TrackedModel, seed: int, moves: bool = True, *, step: Step
) -> HeldOutErrors:
    """Step: errors at observations that neither points were adjusted to nor, where it `moves` them, the model's poses.

    The start keeps its poses; its points too, where the model does not move them either.
    """
    out = []
    for one, adjusts in ((start, "points" if moves else "nothing"), (model, "all" if moves else "points")):
        chosen = np.random.default_rng(seed).random(len(one.quality.errors_px)) < HELD_OUT_SHARE
        out.append(one.held_out_errors(chosen, adjusts))
    if len(out[0]) != len(out[1]):  # tracks were merged: they are not the same observations
        return HeldOutErrors(np.zeros((2, 0)))
    return HeldOutErrors(np.array(out))


def held_out_score(distances_m: Floats) -> Measure:
    """The score of the pairs held out (2, H), before and after; its noise is that of the mean of their differences."""
    scores = np.exp(-distances_m / SIGMA_M)
    scores = scores[:, np.isfinite(scores).all(axis=0)]
    count = scores.shape[1]
    noise = 2 * float((scores[1] - scores[0]).std()) / np.sqrt(max(count, 1))
    before, after = scores.mean(axis=1) if count else (np.nan, np.nan)
    name = f"cloud-to-cloud score of {count} held-out pairs"
    return Measure(name, float(before), float(after), "higher", max(noise, SCORE_TOLERANCE))
