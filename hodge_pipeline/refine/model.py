"""Refine a model with tracks: make candidates, measure them by one cost, keep the best, or else the input."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.errors import SourceError
from hodge_pipeline.evaluation.difference import alike
from hodge_pipeline.executors.dask import open_workers
from hodge_pipeline.refine.candidates import GIVEN, CandidateSet, make_candidates
from hodge_pipeline.refine.choice import UNTOLD, Choice, choose, held_out_score, refused_doubt
from hodge_pipeline.refine.focal import intrinsics_doubt
from hodge_pipeline.refine.frame import in_frame_of
from hodge_pipeline.refine.guard import Decision, Measure, PoseChange
from hodge_pipeline.refine.model_edges import held_out_distances
from hodge_pipeline.refine.model_options import ModelRefinement
from hodge_pipeline.refine.model_solve import Solved
from hodge_pipeline.refine.pieces import pieces_doubt
from hodge_pipeline.refine.reprojection_cost import SAME_COST, ReprojectionCost, named, spoilt_doubt
from hodge_pipeline.refine.scale import Scale, metric_scale
from hodge_pipeline.refine.uncertainty import SIGMAS, loose, moves
from hodge_pipeline.stages import Steps, Workers
from hodge_pipeline.types import Floats
from hodge_pipeline.types.arrays import rms
from hodge_pipeline.types.tracked_model import TrackedModel

NO_OBSERVATION = (
    "the model has no point that two images saw: nothing tells good poses from bad: triangulate points first"
)
ONE_IMAGE = "the model has one image with a pose: nothing tells whether it is right: give a model of two or more"
JOIN_LOSS = 0.25
"""Share by which the cost may grow when models are joined: each was fitted to its own images alone."""


@dataclass(frozen=True)
class RefinedModel:
    """One refined model and the input models that it joins.

    `start` is the inputs joined, in metres where depth tells the scale; `model` the chosen candidate. `candidates` are
    names with costs, of which row `kept_row` is written. `solved` is None where no consistent solve was needed.
    """

    inputs: tuple[TrackedModel, ...]
    start: TrackedModel
    model: TrackedModel
    scales: tuple[Scale, ...]
    final_scale: Scale
    candidates: tuple[tuple[str, ReprojectionCost], ...]
    kept_row: int
    solved: Solved | None
    decision: Decision
    notes: tuple[str, ...]

    @property
    def kept(self) -> Sequence[TrackedModel]:
        """The models to be written: the refined one, or the inputs unchanged."""
        return self.inputs if self.decision.keeps_input else (self.model,)


def refine_models(
    models: Sequence[TrackedModel],
    options: ModelRefinement,
    steps: Steps,
    key: str,
    *,
    force: bool,
    dask: str | None,
) -> tuple[RefinedModel, ...]:
    """Every model refined; models that measurements join become one. Nothing is written but the steps.

    `key` identifies the models and the options that opened them. A model that cannot be refined becomes a note; raises
    `SourceError` where none can.
    """
    models, left_out = refinable(models)
    scales = [metric_scale(model.seen_depths()) for model in models]
    metric = [in_metres(model, scale) for model, scale in zip(models, scales, strict=True)]
    out = []
    with open_workers(options.executor, dask) as workers:
        for number, (joined, rows) in enumerate(options.model.join(metric)):
            joined = joined.placed()
            steps.remember(joined, f"{key}-{number}")
            given = tuple(models[row] for row in rows), tuple(scales[row] for row in rows)
            out.append(_refine(joined, *given, options, steps, workers, force))
    return (replace(out[0], notes=(*left_out, *out[0].notes)), *out[1:])


def refinable(models: Sequence[TrackedModel]) -> tuple[Sequence[TrackedModel], tuple[str, ...]]:
    """The models whose observations can test poses, and a line on why each other one is left out.

    Raises `SourceError` where there is none.
    """
    reasons = [_unfit(model) for model in models]
    told = tuple(f"{model.name}: {reason}" for model, reason in zip(models, reasons, strict=True) if reason)
    fit = [model for model, reason in zip(models, reasons, strict=True) if not reason]
    if not fit:
        raise SourceError("; ".join(told))
    return fit, tuple(f"left out: {line}" for line in told)


def _unfit(model: TrackedModel) -> str:
    """Why a model cannot be refined; "" where it can."""
    if model.quality.images < 2:
        return ONE_IMAGE
    return "" if (model.quality.track_lengths > 1).any() else NO_OBSERVATION


def in_metres(model: TrackedModel, scale: Scale) -> TrackedModel:
    """The model in metres; unchanged where depth does not tell its scale, or tells that it is in metres."""
    return model if scale.is_one or not scale.is_observable else _resized(model, scale.metres_per_unit)


def _resized(model: TrackedModel, factor: float) -> TrackedModel:
    """The model times the factor about the mean of its bodies: about a far origin (UTM) it would move by kilometres."""
    centre = model.world_from_body[:, :3, 3].mean(axis=0)
    return model.scaled(factor, se3.from_parts(np.eye(3), (1 - factor) * centre))


def _refine(
    start: TrackedModel,
    inputs: tuple[TrackedModel, ...],
    scales: tuple[Scale, ...],
    options: ModelRefinement,
    steps: Steps,
    workers: Workers,
    force: bool,
) -> RefinedModel:
    """The joined model `start` refined: candidates, choice, scale, doubts, decision."""
    is_metric = all(scale.is_observable for scale in scales)
    found = make_candidates(inputs, start, options, steps, workers, is_metric)
    distances_m = held_out_distances(found.depth, _metric_poses(found), workers)
    choice = choose(found, distances_m, options.seed, steps, force=force)
    at, model = choice.row, found.candidates[choice.row].model
    in_world = start.known_positions is not None
    final = metric_scale(model.seen_depths()) if any(scale.is_observable for scale in scales) else scales[0]
    if final.is_observable and not in_world:
        model, final = _resized(model, final.metres_per_unit), replace(final, metres_per_unit=1.0)
        model = in_frame_of(start, model, keeps_size=True) if at else model
    change = _change(start, scales[0], model, in_world) if len(inputs) == 1 and at else None
    cost = found.costs[at]
    doubt = (
        intrinsics_doubt(found, steps)
        or refused_doubt(found, choice, distances_m)
        or cost.doubt
        or cost.images_doubt
        or spoilt_doubt(found.costs[0], cost)
        or ("" if found.depth.graph.edge_count or in_world else pieces_doubt(model))
    )
    doubt = doubt or (_loose_doubt(start, model) if not found.candidates[at].holds_poses and not is_metric else "")
    decision = _placed_decision(start, found, choice) or _decision(found, choice, scales, force, bool(doubt))
    measures = _measures(found, at, start, model, distances_m)
    names = [(one.name, cost) for one, cost in zip(found.candidates, found.costs, strict=True)]
    candidates = names if len(inputs) == 1 else [(f"{len(inputs)} models apart", found.inputs), *names]
    notes = (*model.notes, *found.notes, *(str(scale) for scale in scales))
    doubt = ": ".join(filter(None, (final.doubt, doubt)))
    decision = replace(decision, measures=measures, change=change, doubt=doubt)
    kept = 0 if decision.keeps_input else at + len(candidates) - len(names)
    return RefinedModel(inputs, start, model, scales, final, tuple(candidates), kept, found.solved, decision, notes)


def _loose_doubt(start: TrackedModel, model: TrackedModel) -> str:
    """Why a model without metres is in doubt: tracks fix some of its poses too badly; "" where they do not."""
    names = [str(name) for name, one in zip(model.body_names, loose(start, model), strict=True) if one]
    return f"in doubt, since tracks fix {named(names)} less well than the poses moved" if names else ""


def _placed_decision(start: TrackedModel, found: CandidateSet, choice: Choice) -> Decision | None:
    """The decision on a model that known positions placed in the world, which is always written; None of others."""
    if not start.placing:
        return None
    off, name = found.position_errors_m, found.candidates[choice.row].name
    fit = f", {off[0]:.3g} → {off[choice.row]:.3g} m off in the median" if np.isfinite(off[0]) else ""
    told = f"mean error {' → '.join(alike(found.costs[0].px, found.costs[choice.row].px, 4))} px{_by(name)}"
    return Decision("refined", f"{start.placing}{fit}; {told}")


def _decision(found: CandidateSet, choice: Choice, scales: Sequence[Scale], force: bool, doubted: bool) -> Decision:
    """Whether the chosen candidate replaces the input; `doubted`: another check doubts even what is kept."""
    before, after = found.costs[0], found.costs[choice.row]
    name = found.candidates[choice.row].name
    if len(scales) > 1:
        return _join_decision(found.inputs, after, name, force)
    told = f"mean error {' → '.join(alike(before.px, after.px, 4))} px{_by(name)}"
    if scales[0].is_observable and not scales[0].is_one:
        return Decision("refined", f"in metres now; {told}")
    if not choice.row:
        lead = "" if doubted or choice.reason == UNTOLD else "already optimal: "
        return Decision("worse" if before.doubt else "optimal", f"{lead}{choice.reason}")
    return Decision("forced", f"{choice.reason}; {told}") if choice.reason else Decision("refined", told)


def _join_decision(apart: ReprojectionCost, joined: ReprojectionCost, name: str, force: bool) -> Decision:
    """Whether one model replaces several: it fits hardly worse than these apart, and puts no more images off."""
    told = f"mean error {apart.px:.4g} px apart, {joined.px:.4g} px as one{_by(name)}"
    if joined.px <= (1 + JOIN_LOSS) * apart.px and len(joined.images_off) <= len(apart.images_off):
        return Decision("refined", f"the models are one; {told}")
    return Decision("forced" if force else "worse", f"the models do not fit as one: {told}")


def _by(candidate: str) -> str:
    return ", with the poses as given" if candidate == GIVEN else f" by {candidate}"


def _metric_poses(found: CandidateSet) -> Floats:
    """Image poses (K, N, 4, 4) of the candidates, each in metres by its own depth, to lay clouds of depth by.

    Bundle adjustment leaves the size of a model free.
    """
    models = [candidate.model for candidate in found.candidates]
    poses = np.array([[frame.world_from_cam for frame in model.frames] for model in models])
    if len(found.depth.held_out):
        for own, model in zip(poses, models, strict=True):
            own[:, :3, 3] *= metric_scale(model.seen_depths()).metres_per_unit
    return poses


def _measures(
    found: CandidateSet, at: int, start: TrackedModel, model: TrackedModel, distances_m: Floats
) -> tuple[Measure, ...]:
    """What the report shows of the chosen candidate, row `at`, beside the input."""
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
        out.append(held_out_score(distances_m[[0, at]]))
    return tuple(out)


def _change(start: TrackedModel, scale: Scale, model: TrackedModel, in_world: bool) -> PoseChange:
    """How far the bodies moved from the input's poses, aligned to them, and the uncertainty that the tracks leave."""
    before, after = start.world_from_body, model.world_from_body
    moved = moves(before, after)
    errors = model.information.standard_errors
    known = errors[np.isfinite(errors).all(axis=1)]
    rotation, position = np.sqrt((known**2).mean(axis=0)) if len(known) else (np.nan, np.nan)
    if scale.is_observable:  # an error of the scale moves a body by as much as it is from the middle
        size = np.sqrt(np.mean(np.sum((after[:, :3, 3] - after[:, :3, 3].mean(axis=0)) ** 2, axis=1)))
        position = float(np.hypot(position, scale.sigma * size))
    return PoseChange(
        translation_m=rms(moved[:, 1]),
        rotation_deg=float(np.degrees(rms(moved[:, 0]))),
        translation_uncertainty_m=float(SIGMAS * position * np.sqrt(3)),
        rotation_uncertainty_deg=float(np.degrees(SIGMAS * rotation * np.sqrt(3))),
        is_metric=scale.is_observable or in_world,
    )
