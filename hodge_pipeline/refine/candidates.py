"""The candidates of a refined model: bundle adjustment from each of several initial poses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hodge_pipeline.errors import SourceError
from hodge_pipeline.refine.frame import in_frame_of, parts_laid_on
from hodge_pipeline.refine.model_edges import DepthEdges, depth_edges, no_depth_edges
from hodge_pipeline.refine.model_options import ModelRefinement
from hodge_pipeline.refine.model_solve import Solved, position_priors, solve_bodies
from hodge_pipeline.refine.reprojection_cost import LEAST_CAP_PX, SAME_COST, ReprojectionCost, best, costs, mends
from hodge_pipeline.refine.uncertainty import likeliest, told_apart
from hodge_pipeline.stages import Step, Steps, Workers
from hodge_pipeline.types import Bools, Floats, PositionPriors, ViewGraph
from hodge_pipeline.types.tracked_model import TrackedModel

MODEL = "model"
GIVEN, POINTS, ADJUSTED = "as given", "bundle adjustment of points alone", "bundle adjustment"
RESECTED = "resection and bundle adjustment"
ROBUST, ROBUST_POINTS = "resection and robust bundle adjustment", "robust bundle adjustment of points alone"
AFTER_ROBUST = "bundle adjustment without a robust loss from there"
CONSISTENT, MENDED = "consistent poses and bundle adjustment", "images that are off placed anew and bundle adjustment"
PARTS_LAID = "bundle adjustment of parts laid on the input"
MOST_RESECTIONS = 3
"""Rounds of resecting doubtful images: one that is placed well gives points that its neighbours are placed by."""
NO_EDGE = "no edge was found: no two images share enough points, matches or depth (model.min_shared)"
NO_EDGE_LEFT = "every edge was rejected: no two of them agree"


@dataclass(frozen=True)
class CandidateModel:
    """A bundle-adjusted model, and how the report names the way it was made; `holds_poses`: it has the input's;
    `has_converged`: more steps of that adjustment would gain nothing.
    """

    name: str
    model: TrackedModel
    holds_poses: bool = False
    has_converged: bool = True


@dataclass(frozen=True)
class CandidateSet:
    """K candidates in the order in which they were made, the joined input in row 0, with the cost of each.

    `inputs` is the cost of the input models, each in its own gauge. `solved`, the consistent solve, is None where it
    was not needed or no edge was measured.
    """

    inputs: ReprojectionCost
    candidates: Sequence[CandidateModel]
    costs: Sequence[ReprojectionCost]
    solved: Solved | None
    depth: DepthEdges
    notes: tuple[str, ...]

    @property
    def position_errors_m(self) -> Floats:
        """The median distance (K,) of each candidate's bodies from their known positions; NaN without any."""
        known = self.candidates[0].model.known_positions
        if known is None:
            return np.full(len(self.candidates), np.nan)
        found = np.array([one.model.world_from_body[:, :3, 3] for one in self.candidates])
        return np.asarray(np.nanmedian(np.linalg.norm(found - known.positions, axis=2), axis=1))

    @property
    def best(self) -> int:
        """The row of the candidate with the lowest cost."""
        return best(self.costs)

    def px(self, row: int) -> float:
        """The cost of a candidate, pixels."""
        return self.costs[row].px

    @property
    def best_held(self) -> int:
        """The row of the lowest cost among the candidates that have the input's poses."""
        return min((row for row, one in enumerate(self.candidates) if one.holds_poses), key=self.px)


class _Candidates:
    """The candidates so far and their costs, which change with every new one: all are measured on one scale."""

    def __init__(self, inputs: Sequence[TrackedModel], start: TrackedModel, steps: Steps) -> None:
        self._inputs, self._steps = [model.quality for model in inputs], steps
        self.candidates, self.notes = [CandidateModel(GIVEN, start, holds_poses=True)], list[str]()
        self._start, self._known, self._lays_parts = start, start.known_positions, False
        self.update_costs()

    def update_costs(self) -> None:
        """Measure the inputs and all candidates again."""
        self.inputs, *self.costs = costs(self._inputs, [one.model.quality for one in self.candidates])

    @property
    def best(self) -> int:
        """The row of the candidate with the lowest cost."""
        return best(self.costs)

    @property
    def is_settled(self) -> bool:
        """Whether the best is sound, or two that began at other poses reached one optimum that leaves no image off."""
        lowest = self.costs[self.best]
        rows = [row for row, one in enumerate(self.candidates) if not one.holds_poses]
        same = [row for row in rows if self.costs[row].px <= (1 + SAME_COST) * lowest.px]
        return lowest.is_sound or (len(same) > 1 and not lowest.images_off)

    @property
    def is_at_optimum(self) -> bool:
        """Whether the input is sound and an adjustment of all leaves it as good: one of points alone gains nothing.

        Known positions draw an adjustment away from the optimum of the tracks.
        """
        if len(self.costs) < 2 or self._known is not None:
            return False
        given, adjusted = self.costs[0], self.costs[-1]
        return given.is_sound and abs(adjusted.px - given.px) <= SAME_COST * given.px

    @property
    def is_mended(self) -> bool:
        """Whether the last candidate is an optimum, sound, and surely better than any points at the input's poses.

        From a start as far off, other adjustments go on for hundreds of steps and end at the same optimum or a worse
        one. Where its own did not converge, tracks fix poses so badly that others may end at a far better one. Where
        the rays of the input's poses meet stands for the points that an adjustment of these alone would find: both have
        as many observations beyond the cap.
        """
        last, model = self.costs[-1], self.candidates[-1].model
        if len(self.costs) < 2 or not last.is_sound or not self.candidates[-1].has_converged:
            return False
        held = self._start.moved(self._start.world_from_body).quality
        _, before, after = costs(self._inputs, [held, model.quality])
        return not before.is_sound and mends(before, after) and told_apart(self._start, model)

    def decide_on_parts(self, resected: Floats) -> None:
        """Lay parts where most observations fit neither the start nor these poses (B, 4, 4) of its points.

        An adjustment that begins near an optimum leaves parts where they were; one that goes far moves them at will.
        """
        self._lays_parts = self._known is None and _is_far(self._start) and _is_far(self._start.moved(resected))

    def add(
        self,
        name: str,
        model: TrackedModel,
        poses: Floats | None = None,
        priors: PositionPriors | None = None,
        *,
        move_bodies: bool = True,
        whole_steps: bool = False,
        row: int | None = None,
    ) -> None:
        """Adjust a model, as a step, from its own poses or from these (B, 4, 4), or its points alone; a failure is a
        note. It becomes the candidate of this row, by default the last.
        """
        start = model, poses, priors or self._known
        try:
            found = self._steps.step(adjusted_model, *start, move_bodies, whole_steps, title=name)
        except SourceError as error:
            self.notes.append(f"{name}: {error}")
            return
        adjusted = model.read_back(found.folder, found.notes)
        if move_bodies and self._known is None:
            adjusted = in_frame_of(self._start, adjusted)
            if self._lays_parts and priors is None:
                found, adjusted = self._with_parts_laid(found, adjusted)
        self._steps.remember(adjusted, self._steps.key(found))
        at = len(self.candidates) if row is None else row
        self.candidates.insert(at, CandidateModel(name, adjusted, not move_bodies, found.has_converged))
        self.update_costs()

    def _with_parts_laid(self, found: AdjustedModel, adjusted: TrackedModel) -> tuple[AdjustedModel, TrackedModel]:
        """The same, its parts laid on the start, adjusted once more, and laid on the most likely poses; as it is, with
        a note, where that adjustment fails.

        A shared point or two tell some of how parts lie: more than a start that is far off, less than one that is near.
        """
        laid = parts_laid_on(self._start.world_from_body, adjusted)
        if laid is adjusted:
            return found, adjusted
        self._steps.remember(laid, self._steps.key([self._start, found, PARTS_LAID]))
        try:
            again = self._steps.step(adjusted_model, laid, None, None, title=PARTS_LAID)
        except SourceError as error:
            self.notes.append(f"{PARTS_LAID}: {error}")
            return found, adjusted
        adjusted = in_frame_of(self._start, laid.read_back(again.folder, again.notes))
        return again, parts_laid_on(likeliest(self._start.world_from_body, adjusted), adjusted)


def _is_far(model: TrackedModel) -> bool:
    return bool(np.median(model.quality.errors_px) > LEAST_CAP_PX)


def make_candidates(
    inputs: Sequence[TrackedModel],
    start: TrackedModel,
    options: ModelRefinement,
    steps: Steps,
    workers: Workers,
    is_metric: bool,
) -> CandidateSet:
    """Candidates from the cheapest way to start to the dearest, until the best one leaves nothing to explain.

    Depth takes part only where the model is in metres: without a scale its clouds do not fit the model's unit.
    """
    found, model, first_robust = _Candidates(inputs, start, steps), start, 0
    poses = None
    if not found.costs[0].is_sound:
        poses = steps.step(resected, start, None, title="resection")
        found.decide_on_parts(poses)
        found.add(RESECTED, start, poses, whole_steps=True)
    if not found.is_mended:
        found.add(ADJUSTED, start, row=1)
        if not found.is_at_optimum:
            found.add(POINTS, start, move_bodies=False, row=1)
    if poses is not None and not found.costs[found.best].is_sound:
        first_robust = len(found.candidates)
        key, model = steps.key([start, ROBUST]), start.with_robust_loss()
        steps.remember(model, key)
        found.add(ROBUST_POINTS, model, move_bodies=False)
        found.add(ROBUST, model, poses)
    depth = depth_edges(model, options, steps, workers) if is_metric else no_depth_edges(model)
    solved = None
    if not found.is_settled or model.held_apart or depth.graph.edge_count:
        solved = _add_consistent(found, model, depth, options, steps)
    _add_resected(found, steps)
    if model is not start:
        _add_without_robust_loss(found, start, first_robust)
    return CandidateSet(found.inputs, found.candidates, found.costs, solved, depth, (*depth.notes, *found.notes))


def _add_consistent(
    found: _Candidates, model: TrackedModel, depth: DepthEdges, options: ModelRefinement, steps: Steps
) -> Solved | None:
    """Solve the graph of all edges, and add the candidate that starts from its poses; None without an edge."""
    measured, left_out = steps.step(measured_edges, model, title="edges")
    found.notes += left_out
    graph = ViewGraph.joined([measured, depth.graph])
    if not graph.edge_count:
        found.notes.append(NO_EDGE)
        return None
    solved = solve_bodies(graph, model.world_from_body, options.solver)
    found.notes += solved.solution.notes
    if not solved.solution.kept.any():
        found.notes.append(NO_EDGE_LEFT)
        return solved
    with_depth = bool((solved.solution.kept & (solved.graph.source == "depth")).any())
    priors = position_priors(solved) if with_depth else None
    found.add(CONSISTENT, model, solved.solution.world_from_cam, priors)
    return solved


def _add_resected(found: _Candidates, steps: Steps) -> None:
    """Add the best candidate with its doubtful images resected from the points of the others, while that is better."""
    for _ in range(MOST_RESECTIONS):
        at = found.best
        doubtful = found.costs[at].images_in_doubt if at else ()
        if not doubtful:
            return
        model = found.candidates[at].model
        names = np.array([str(frame.frame_id) for frame in model.frames])
        bodies = np.zeros(len(model.body_names), bool)
        bodies[model.body_of_frame[np.isin(names, doubtful)]] = True
        poses = steps.step(resected, model, bodies, title="resection")
        found.add(MENDED, model, poses)
        if found.best == at:
            return


def _add_without_robust_loss(found: _Candidates, start: TrackedModel, first_robust: int) -> None:
    """Adjust the best poses with the squared loss; where that is sound it replaces the robust candidates.

    A sound result shows that the tracks are right, so a loss that discounts them only loses accuracy.
    """
    found.add(AFTER_ROBUST, start, found.candidates[found.best].model.world_from_body)
    added = found.candidates[-1].name == AFTER_ROBUST
    if added and found.costs[-1].is_sound:
        found.candidates[first_robust:-1] = []
        found.update_costs()


def resected(model: TrackedModel, bodies: Bools | None, *, step: Step) -> Floats:
    """Step: the poses (B, 4, 4) of the bodies with these (B,) placed by resection from the model's points; None: all of
    them.
    """
    return model.resected(bodies)


def measured_edges(model: TrackedModel, *, step: Step) -> tuple[ViewGraph, tuple[str, ...]]:
    """Step: the model's relative motions by two-view geometry, and a note on each kind of pair left out."""
    return model.measured()


@dataclass(frozen=True)
class AdjustedModel:
    """The folder of a model that bundle adjustment wrote, its notes, and whether the adjustment converged."""

    folder: Path
    notes: tuple[str, ...]
    has_converged: bool


def adjusted_model(
    start: TrackedModel,
    poses: Floats | None,
    priors: PositionPriors | None,
    move_bodies: bool = True,
    whole_steps: bool = False,
    *,
    step: Step,
) -> AdjustedModel:
    """Step: bundle adjustment from the model's own poses, or from these (B, 4, 4) with matched points merged.

    Adjustment brings more matched points together: these are merged after it, and adjusted once more. Without
    `move_bodies` its points alone are adjusted, and none is merged. With `whole_steps` poses that make the model sound
    count as near its optimum, see `TrackedModel.adjusted`: not for a robust loss, which has many optima, nor after one,
    where a few gross errors may pull far. Raises `SourceError` where it fails.
    """
    if not move_bodies:
        return _written(start.moved(start.world_from_body).adjusted(move_bodies=False), step)
    model = start if poses is None else start.moved(poses).merged()
    is_near = whole_steps and costs([start.quality], [model.quality])[1].is_sound
    adjusted = model.adjusted(priors, near_optimum=is_near)
    if poses is not None:
        merged = adjusted.merged()
        adjusted = adjusted if merged is adjusted else merged.moved(merged.world_from_body).adjusted(priors)
    return _written(adjusted, step)


def _written(adjusted: TrackedModel, step: Step) -> AdjustedModel:
    if not np.isfinite(adjusted.world_from_body).all():
        raise SourceError("bundle adjustment leaves poses that are no numbers")
    folder = step.folder / MODEL
    folder.mkdir(exist_ok=True)
    adjusted.write(folder)
    return AdjustedModel(folder, tuple(adjusted.notes), adjusted.has_converged)
