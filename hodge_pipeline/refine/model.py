"""Refine a model with tracks: candidates weighed by one cost, the best of them kept, never one worse than the input."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.errors import SourceError
from hodge_pipeline.evaluation.scores import SIGMA_M
from hodge_pipeline.evaluation.trajectory import absolute_error, align
from hodge_pipeline.executors.dask import open_workers
from hodge_pipeline.refine.candidates import CONSISTENT, Candidate, Found, weigh
from hodge_pipeline.refine.guard import Change, Decision, Measure
from hodge_pipeline.refine.judge import SAME_COST, Cost
from hodge_pipeline.refine.model_edges import held_out_distances
from hodge_pipeline.refine.model_options import ModelRefinement
from hodge_pipeline.refine.model_solve import Solved
from hodge_pipeline.refine.scale import Scale, metric_scale
from hodge_pipeline.refine.uncertainty import SIGMAS
from hodge_pipeline.stages import Step, Steps, TrackedModel, Workers
from hodge_pipeline.types import Floats

NO_OBSERVATION = (
    "the model has no point that two images saw: nothing tells good poses from bad: triangulate points first"
)
LEAST_GAIN = 0.01
"""Of the cost: less is what an adjustment gains by fitting the noise of the keypoints."""
CLEAR_GAIN = 0.5
"""Of the cost: half of it is more than any way to weigh observations; below it observations held out decide as well."""
LEAST_MOVE, GAIN_TO_MOVE = 1e-3, 0.2
"""Of the extent of the cameras: poses that move by more need a gain of a fifth, since a lens that does not quite fit
moves them by as much and gains a few per cent."""
JOIN_LOSS = 0.25
"""Of the cost: so much more of it is the price of one model in place of several that each fitted its own images."""
MERGE_LOSS = 0.05
"""Of the cost: so much more of it is the price of points that a match makes one."""
HELD_OUT_SHARE, LEAST_TRACK = 0.1, 4
"""Of the observations of points that so many images saw: what is left still places the point."""
SCORE_TOLERANCE = 0.002
NO_BASELINE = 1e-9
"""Of the size of the model: a sensor nearer than this to its rig's origin is off it by rounding alone."""


@dataclass(frozen=True)
class RefinedModel:
    """One model refined, with the models it was made of.

    `start` is the input in metres (where depth tells) and joined; `model` the best candidate. `solved` is None where
    the consistent solve was not needed.
    """

    inputs: tuple[TrackedModel, ...]
    start: TrackedModel
    model: TrackedModel
    scales: tuple[Scale, ...]
    final_scale: Scale
    candidates: tuple[tuple[str, Cost], ...]
    solved: Solved | None
    decision: Decision
    notes: tuple[str, ...]

    @property
    def kept(self) -> Sequence[TrackedModel]:
        """The models to be written: the refined one, or the inputs as they came."""
        return self.inputs if self.decision.keeps_input else (self.model,)


def refine_models(
    models: Sequence[TrackedModel],
    options: ModelRefinement,
    steps: Steps,
    key: str,
    *,
    force: bool = False,
    dask: str | None = None,
) -> tuple[RefinedModel, ...]:
    """Every model refined, those that measurements tie together as one. Nothing is written but the steps.

    `key` stands for the models and the options that open them. Raises `SourceError` for a model without observations.
    """
    scales = [metric_scale(model.depth_ratios()) for model in models]
    metric = [in_metres(model, scale) for model, scale in zip(models, scales, strict=True)]
    out = []
    with open_workers(options.executor, dask) as workers:
        for number, joined in enumerate(options.model.join(metric)):
            parts = [row for row, model in enumerate(metric) if set(model.body_names) & set(joined.body_names)]
            steps.remember(joined, f"{key}-{number}")
            given = tuple(models[row] for row in parts), tuple(scales[row] for row in parts)
            out.append(_refine(joined, *given, options, steps, workers, force))
    return tuple(out)


def in_metres(model: TrackedModel, scale: Scale) -> TrackedModel:
    """The model in metres, or as it is where depth does not tell its scale or finds it right."""
    return model if scale.is_one or not scale.is_observable else model.scaled(scale.metres_per_unit)


def _refine(
    start: TrackedModel,
    inputs: tuple[TrackedModel, ...],
    scales: tuple[Scale, ...],
    options: ModelRefinement,
    steps: Steps,
    workers: Workers,
    force: bool,
) -> RefinedModel:
    if not (start.quality.track_lengths > 1).any():
        raise SourceError(f"{start.name}: {NO_OBSERVATION}")
    is_metric = all(scale.is_observable for scale in scales)
    found = weigh(inputs, start, options, steps, workers, is_metric)
    distances_m = held_out_distances(found.depth, _image_poses([one.model for one in found.candidates]), workers)
    at = _chosen(found, distances_m, force)
    chosen = found.candidates[at].model
    model = chosen if at == 0 or is_metric else _in_the_scale_of(start, chosen)
    final = metric_scale(model.depth_ratios()) if any(scale.is_observable for scale in scales) else scales[0]
    if final.is_observable:
        model, final = model.scaled(final.metres_per_unit), replace(final, metres_per_unit=1.0)
    change = _change(start, scales[0], model) if len(inputs) == 1 and at else None
    decision = _decision(found, at, change, [start, model], scales, options, steps, force)
    measures = _measures(found, at, start, model, distances_m)
    names = [(one.name, cost) for one, cost in zip(found.candidates, found.costs, strict=True)]
    candidates = names if len(inputs) == 1 else [(f"{len(inputs)} models apart", found.inputs), *names]
    notes = (*model.notes, *found.notes, *(str(scale) for scale in scales))
    decision = replace(decision, measures=measures, change=change)
    return RefinedModel(inputs, start, model, scales, final, tuple(candidates), found.solved, decision, notes)


def _chosen(found: Found, distances_m: Floats, force: bool) -> int:
    """The row of the candidate that is weighed against the input.

    The lowest cost, or a little more of it where further measurements took part: points that matches merged, or depth
    whose pairs held out fit no worse. With `force` the best of those that are not the input.
    """
    at = found.best
    if force and at == 0 and len(found.costs) > 1:
        at = min(range(1, len(found.costs)), key=lambda row: found.costs[row].px)
    points = found.candidates[0].model.quality.points
    for row, candidate in enumerate(found.candidates):
        if found.costs[row].px > (1 + MERGE_LOSS) * found.costs[at].px:
            continue
        if candidate.model.quality.points < min(points, found.candidates[at].model.quality.points) or found.with_depth and candidate.name == CONSISTENT and not _is_worse(distances_m[[0, row]]):
            at = row
    return at


def _is_worse(distances_m: Floats) -> bool:
    return bool(distances_m.size) and _score(distances_m).is_worse


def _decision(
    found: Found,
    at: int,
    change: Change | None,
    models: Sequence[TrackedModel],
    scales: Sequence[Scale],
    options: ModelRefinement,
    steps: Steps,
    force: bool,
) -> Decision:
    """Whether the candidate takes the place of the input."""
    before, after = found.costs[0], found.costs[at]
    name = found.candidates[at].name
    if len(scales) > 1:
        return _join_decision(found.inputs, after, name, force)
    told = f"mean error {before.px:.4g} -> {after.px:.4g} px by {name}"
    if scales[0].is_observable and not scales[0].is_one:
        return Decision("refined", f"in metres now; {told}")
    if found.candidates[at].model.quality.points < models[0].quality.points:
        return Decision("refined", f"points that matches make one are merged; {told}")
    gain = 1.0 - after.px / before.px if before.px > 0 else 0.0
    reason = _reason_to_keep(gain, models, found.candidates[at], options, steps) if at else "no candidate costs less"
    if not reason:
        return Decision("refined", told)
    if force and at:
        return Decision("forced", f"{reason}; {told}")
    return Decision("optimal", f"already optimal: {reason}")


def _join_decision(apart: Cost, joined: Cost, name: str, force: bool) -> Decision:
    told = f"mean error {apart.px:.4g} px apart, {joined.px:.4g} px as one, by {name}"
    if joined.px <= (1 + JOIN_LOSS) * apart.px and len(joined.images_off) <= len(apart.images_off):
        return Decision("refined", f"the models are one; {told}")
    return Decision("forced" if force else "worse", f"the models do not fit as one: {told}")


def _reason_to_keep(
    gain: float, models: Sequence[TrackedModel], candidate: Candidate, options: ModelRefinement, steps: Steps
) -> str:
    """Why the input is kept all the same, empty where the candidate is clearly better."""
    if gain < LEAST_GAIN:
        return f"the best candidate gains {gain:.2%} of the mean error, less than its noise"
    if gain >= CLEAR_GAIN:
        return ""
    start, model = models
    centres = start.world_from_body[:, :3, 3]
    moved = absolute_error(model.world_from_body, start.world_from_body, with_scale=True).rmse_m
    share = moved / max(float(np.linalg.norm(np.ptp(centres, axis=0))), 1e-300)
    if share > LEAST_MOVE and gain < GAIN_TO_MOVE:
        return f"the best candidate gains {gain:.1%} of the mean error and moves the cameras by {share:.2%} of their extent"
    errors = steps.step(held_out_errors, start, candidate.model, options.seed, title="observations held out").errors_px
    if not errors.size:
        return ""
    medians, capped = np.median(errors, axis=1), np.minimum(errors, 4.0).mean(axis=1)
    if medians[1] < medians[0] and capped[1] < capped[0]:
        return ""
    return f"observations held out are {medians[0]:.4g} px off, {medians[1]:.4g} px after the best candidate"


@dataclass(frozen=True)
class HeldOutErrors:
    """Errors (2, H) in pixels of the observations held out, before and after."""

    errors_px: Floats


def held_out_errors(start: TrackedModel, model: TrackedModel, seed: int, *, step: Step) -> HeldOutErrors:
    """Step: errors at observations that neither points nor poses were adjusted to: of the start's poses, the model's."""
    random = np.random.default_rng(seed).random(len(start.quality.track_lengths))
    chosen = (random < HELD_OUT_SHARE) & (start.quality.track_lengths >= LEAST_TRACK)
    pairs = ((start, False), (model, True))
    return HeldOutErrors(np.array([one.held_out_errors(chosen, move_bodies=moves) for one, moves in pairs]))


def _in_the_scale_of(start: TrackedModel, model: TrackedModel) -> TrackedModel:
    """The model with the size that the start has: nothing measured tells another, unless a rig's baselines do."""
    baselines = np.abs(start.body_from_cam[:, :3, 3]).max()
    if baselines > NO_BASELINE * np.ptp(start.world_from_body[:, :3, 3], axis=0).max():
        return model
    return model.scaled(align(model.world_from_body, start.world_from_body, with_scale=True).scale)


def _image_poses(models: Sequence[TrackedModel]) -> Floats:
    return np.array([[frame.world_from_cam for frame in model.frames] for model in models])


def _measures(
    found: Found, at: int, start: TrackedModel, model: TrackedModel, distances_m: Floats
) -> tuple[Measure, ...]:
    """What the report shows of the kept candidate beside the input."""
    before, after = found.inputs, found.costs[at]
    count = before.observations
    cap = f"capped at {after.cap_px:.4g} px"
    out = [
        Measure("observations behind a camera", before.behind, after.behind, "lower", 0.001 * count, f"of {count}"),
        Measure(f"mean reprojection error, {cap}", before.px, after.px, "lower", SAME_COST * before.px, "px"),
        Measure("images most of whose points are off", len(before.images_off), len(after.images_off)),
        Measure(
            "mean track length",
            start.quality.mean_track_length,
            model.quality.mean_track_length,
            "higher",
            unit="images",
        ),
    ]
    if distances_m.size:
        out.append(_score(distances_m[[0, at]]))
    return tuple(out)


def _score(distances_m: Floats) -> Measure:
    """The score of the pairs held out (2, H), before and after; its noise is that of the mean of their differences."""
    scores = np.exp(-distances_m / SIGMA_M)
    scores = scores[:, np.isfinite(scores).all(axis=0)]
    count = scores.shape[1]
    noise = 2 * float((scores[1] - scores[0]).std()) / np.sqrt(max(count, 1))
    before, after = scores.mean(axis=1) if count else (np.nan, np.nan)
    name = f"cloud-to-cloud score of {count} held-out pairs"
    return Measure(name, float(before), float(after), "higher", max(noise, SCORE_TOLERANCE))


def _laid_onto(before: Floats, after: Floats) -> Floats:
    """The poses before, moved rigidly onto those after: by their orientations, which small sets of positions lack."""
    turn = se3.project_to_so3((after[:, :3, :3] @ np.swapaxes(before[:, :3, :3], 1, 2)).sum(axis=0))
    shift = (after[:, :3, 3] - before[:, :3, 3] @ turn.T).mean(axis=0)
    return np.asarray(se3.from_parts(turn, shift) @ before)


def _change(start: TrackedModel, scale: Scale, model: TrackedModel) -> Change:
    """How far the poses moved from those of the input, laid onto each other: in metres where depth tells the scale."""
    before, after = start.world_from_body, model.world_from_body
    moved = se3.log(se3.inverse(_laid_onto(before, after)) @ after)
    rotation, position = np.sqrt(np.nanmean(model.standard_errors() ** 2, axis=0))
    if scale.is_observable:  # the size of the whole is as sure as the scale
        size = np.sqrt(np.mean(np.sum((after[:, :3, 3] - after[:, :3, 3].mean(axis=0)) ** 2, axis=1)))
        position = float(np.hypot(position, scale.sigma * size))
    return Change(
        translation_m=float(np.sqrt(np.mean(np.sum(moved[:, 3:] ** 2, axis=1)))),
        rotation_deg=float(np.degrees(np.sqrt(np.mean(np.sum(moved[:, :3] ** 2, axis=1))))),
        translation_uncertainty_m=float(SIGMAS * position * np.sqrt(3)),
        rotation_uncertainty_deg=float(np.degrees(SIGMAS * rotation * np.sqrt(3))),
        is_metric=scale.is_observable,
    )
