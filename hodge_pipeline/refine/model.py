"""Refine a model with tracks: scale, edges, a consistent solve, bundle adjustment, and a judgement of the result."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.evaluation.scores import SIGMA_M
from hodge_pipeline.evaluation.trajectory import align
from hodge_pipeline.executors.dask import open_workers
from hodge_pipeline.refine.guard import Change, Decision, Measure, decide
from hodge_pipeline.refine.model_edges import depth_edges, held_out_distances, no_depth_edges
from hodge_pipeline.refine.model_options import ModelRefinement
from hodge_pipeline.refine.model_solve import Solved, position_priors, solve_bodies
from hodge_pipeline.refine.reprojection import reprojection_measures
from hodge_pipeline.refine.scale import Scale, metric_scale
from hodge_pipeline.refine.uncertainty import SIGMAS
from hodge_pipeline.stages import Step, Steps, TrackedModel, Workers
from hodge_pipeline.types import Floats, ViewGraph

ADJUSTMENTS = 2
"""Rounds of merging points and bundle adjustment: what the first brings together the second can merge."""
NO_EDGE = "no edge was found: no two images share enough points, matches or depth (model.min_shared)"
NO_EDGE_LEFT = "every edge was rejected: no two of them agree"
CHI2_TOLERANCE = 0.05
MODEL = "model"
SCORE_TOLERANCE = 0.002
NO_BASELINE = 1e-9
"""Of the size of the model: a sensor nearer than this to its rig's origin is off it by rounding alone."""


@dataclass(frozen=True)
class RefinedModel:
    """One model refined, with the models it was made of.

    `start` is the input in metres (where depth tells) and joined; `model` what bundle adjustment made of it. `solved`
    is None where nothing was measured, and then the model is as it was.
    """

    inputs: tuple[TrackedModel, ...]
    start: TrackedModel
    model: TrackedModel
    scales: tuple[Scale, ...]
    final_scale: Scale
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

    `key` stands for the models and the options that open them.
    """
    scales = [metric_scale(model.depth_ratios()) for model in models]
    metric = [in_metres(model, scale) for model, scale in zip(models, scales, strict=True)]
    out = []
    with open_workers(options.executor, dask) as workers:
        for number, joined in enumerate(options.model.join(metric)):
            parts = [row for row, model in enumerate(metric) if set(model.body_names) & set(joined.body_names)]
            is_metric = all(scales[row].is_observable for row in parts)
            steps.remember(joined, f"{key}-{number}")
            found = _refine(joined, options, steps, workers, is_metric)
            inputs = tuple(models[row] for row in parts)
            out.append(_judged(inputs, tuple(scales[row] for row in parts), found, options, force))
    return tuple(out)


def in_metres(model: TrackedModel, scale: Scale) -> TrackedModel:
    """The model in metres, or as it is where depth does not tell its scale or finds it right."""
    return model if scale.is_one or not scale.is_observable else model.scaled(scale.metres_per_unit)


@dataclass(frozen=True)
class _Found:
    """What the refinement of one model found, before it is judged."""

    start: TrackedModel
    model: TrackedModel
    solved: Solved | None
    errors: Floats
    distances_m: Floats
    notes: tuple[str, ...]


def _refine(start: TrackedModel, options: ModelRefinement, steps: Steps, workers: Workers, is_metric: bool) -> _Found:
    """Depth takes part where the model is in metres: else its clouds are in another unit, or not of these images."""
    nothing = np.zeros((2, 0))
    measured, left_out = steps.step(measured_edges, start, title="edges")
    depth = depth_edges(start, options, steps, workers) if is_metric else no_depth_edges(start)
    graph = ViewGraph.joined([measured, depth.graph])
    notes = (*left_out, *depth.notes)
    if not graph.edge_count:
        return _Found(start, start, None, np.full((1, 2), np.nan), nothing, (*notes, NO_EDGE))
    solved = solve_bodies(graph, start.world_from_body, options.solver)
    notes = (*notes, *solved.solution.notes)
    if not solved.kept.any():
        return _Found(start, start, solved, np.full((1, 2), np.nan), nothing, (*notes, NO_EDGE_LEFT))
    model, errors = _adjusted(start, solved, options, steps)
    if not is_metric:
        model, errors = _in_the_scale_of(start, model, errors)
    distances = held_out_distances(depth, np.array([_image_poses(start), _image_poses(model)]), workers)
    return _Found(start, model, solved, errors, distances, notes)


def measured_edges(model: TrackedModel, *, step: Step) -> tuple[ViewGraph, tuple[str, ...]]:
    """Step: the model's edges from what its images share, and what was left out."""
    return model.measured()


def _adjusted(
    start: TrackedModel, solved: Solved, options: ModelRefinement, steps: Steps
) -> tuple[TrackedModel, Floats]:
    """The bundle adjustment, read back where it was done before."""
    with_depth = bool((solved.kept & (solved.graph.source == "depth")).any())
    weight = options.depth_weight if with_depth else 0.0
    found = steps.step(adjusted_model, start, solved, weight, title="bundle adjustment")
    return start.read_back(found.folder, found.notes), found.errors


@dataclass(frozen=True)
class AdjustedModel:
    """A folder with what bundle adjustment wrote, the standard errors (B, 2) of its bodies, and remarks."""

    folder: Path
    errors: Floats
    notes: tuple[str, ...]


def adjusted_model(start: TrackedModel, solved: Solved, weight: float, *, step: Step) -> AdjustedModel:
    """Step: the bundle adjustment from the solved poses, which are priors of this weight."""
    model, errors = _adjust(start, solved, weight)
    folder = step.folder / MODEL
    folder.mkdir(exist_ok=True)
    model.write(folder)
    return AdjustedModel(folder, errors, tuple(model.notes))


def _adjust(start: TrackedModel, solved: Solved, weight: float) -> tuple[TrackedModel, Floats]:
    """Points where rays meet at the solved poses, and bundle adjustment, with the solved positions as priors."""
    priors = position_priors(solved, weight)
    model = start.moved(solved.solution.world_from_cam)
    adjusted, errors = model.adjusted(priors)
    for _ in range(ADJUSTMENTS - 1):
        merged = adjusted.moved(adjusted.world_from_body)
        if merged.quality.points == adjusted.quality.points:
            break
        adjusted, errors = merged.adjusted(priors)
    return adjusted, errors


def _in_the_scale_of(start: TrackedModel, model: TrackedModel, errors: Floats) -> tuple[TrackedModel, Floats]:
    """The model with the size that the start has: nothing measured tells another, unless a rig's baselines do."""
    baselines = np.abs(start.body_from_cam[:, :3, 3]).max()
    if baselines > NO_BASELINE * np.ptp(start.world_from_body[:, :3, 3], axis=0).max():
        return model, errors
    factor = align(model.world_from_body, start.world_from_body, with_scale=True).scale
    return model.scaled(factor), errors * [1.0, factor]


def _image_poses(model: TrackedModel) -> Floats:
    return np.array([frame.world_from_cam for frame in model.frames])


def _judged(
    inputs: tuple[TrackedModel, ...],
    scales: tuple[Scale, ...],
    found: _Found,
    options: ModelRefinement,
    force: bool,
) -> RefinedModel:
    model = found.model
    final = metric_scale(model.depth_ratios()) if any(scale.is_observable for scale in scales) else scales[0]
    if found.solved is None or not found.solved.kept.any():
        decision = Decision("nothing", found.notes[-1])
        notes = (*model.notes, *found.notes[:-1])
        return RefinedModel(inputs, found.start, model, scales, final, found.solved, decision, notes)
    if final.is_observable:
        model, final = model.scaled(final.metres_per_unit), replace(final, metres_per_unit=1.0)
    measures = tuple(_measures(inputs, found, model, options))
    change = _change(found.start, scales[0], model, found.errors) if len(inputs) == 1 else None
    rescaled = scales[0].is_observable and not scales[0].is_one
    decision = replace(decide(measures, None if rescaled else change, force=force), change=change)
    notes = (*model.notes, *found.notes, *(str(scale) for scale in scales))
    return RefinedModel(inputs, found.start, model, scales, final, found.solved, decision, notes)


def _measures(
    inputs: tuple[TrackedModel, ...], found: _Found, model: TrackedModel, options: ModelRefinement
) -> Sequence[Measure]:
    qualities = [one.quality for one in inputs]
    count = sum(len(quality.errors_px) for quality in qualities)
    length = count / max(sum(quality.points for quality in qualities), 1)
    after = model.quality
    out = [
        *reprojection_measures(qualities, after, options.reprojection_tolerance),
        Measure("mean track length", length, after.mean_track_length, "higher", 0.01 * length, "images"),
    ]
    assert found.solved is not None
    before_chi2 = found.solved.chi2(found.start.world_from_body)
    after_chi2 = found.solved.chi2(model.world_from_body)
    out.append(Measure("edge chi2", before_chi2, after_chi2, "lower", CHI2_TOLERANCE * max(before_chi2, 1.0)))
    if found.distances_m.size:
        out.append(_score(found.distances_m))
    return out


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


def _change(start: TrackedModel, scale: Scale, model: TrackedModel, errors: Floats) -> Change:
    """How far the poses moved from those of the input in metres, laid onto each other."""
    before, after = start.world_from_body, model.world_from_body
    moved = se3.log(se3.inverse(_laid_onto(before, after)) @ after)
    rotation, position = np.sqrt(np.nanmean(errors**2, axis=0))
    if scale.is_observable:  # the size of the whole is as sure as the scale
        size = np.sqrt(np.mean(np.sum((after[:, :3, 3] - after[:, :3, 3].mean(axis=0)) ** 2, axis=1)))
        position = float(np.hypot(position, scale.sigma * size))
    return Change(
        translation_m=float(np.sqrt(np.mean(np.sum(moved[:, 3:] ** 2, axis=1)))),
        rotation_deg=float(np.degrees(np.sqrt(np.mean(np.sum(moved[:, :3] ** 2, axis=1))))),
        translation_uncertainty_m=float(SIGMAS * position * np.sqrt(3)),
        rotation_uncertainty_deg=float(np.degrees(SIGMAS * rotation * np.sqrt(3))),
    )
