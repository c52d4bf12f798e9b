"""The candidates of a refined model: what bundle adjustment makes of each way to start it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hodge_pipeline.errors import SourceError
from hodge_pipeline.refine.judge import SAME_COST, Cost, best, costs
from hodge_pipeline.refine.model_edges import DepthEdges, depth_edges, no_depth_edges
from hodge_pipeline.refine.model_options import ModelRefinement
from hodge_pipeline.refine.model_solve import Solved, position_priors, solve_bodies
from hodge_pipeline.stages import Step, Steps, TrackedModel, Workers
from hodge_pipeline.types import Bools, Floats, PositionPriors, ViewGraph

MODEL = "model"
GIVEN, POINTS, ADJUSTED = "as given", "bundle adjustment of points alone", "bundle adjustment"
REPLACED = "points placed anew and bundle adjustment"
RESECTED = "resection and bundle adjustment"
ROBUST, ROBUST_POINTS = "resection and robust bundle adjustment", "robust bundle adjustment of points alone"
AFTER_ROBUST = "bundle adjustment without a robust loss from there"
CONSISTENT, MENDED = "consistent poses and bundle adjustment", "images that are off placed anew and bundle adjustment"
MENDINGS = 3
"""Rounds: an image placed anew gives its neighbours points to be placed by."""
NO_EDGE = "no edge was found: no two images share enough points, matches or depth (model.min_shared)"
NO_EDGE_LEFT = "every edge was rejected: no two of them agree"


@dataclass(frozen=True)
class Candidate:
    """A model that might be kept, under the name by which a report calls it; `holds_poses`: those of the input."""

    name: str
    model: TrackedModel
    holds_poses: bool = False


@dataclass(frozen=True)
class Found:
    """The candidates in the order in which they were made, the joined input first, and what each costs.

    `inputs` is the cost of the input models, each in its own gauge. The consistent solve is None where it was not
    needed, or nothing was measured.
    """

    inputs: Cost
    candidates: Sequence[Candidate]
    costs: Sequence[Cost]
    solved: Solved | None
    depth: DepthEdges
    notes: tuple[str, ...]

    @property
    def positions_off(self) -> Floats:
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
    def held(self) -> int:
        """The row of the candidate with the input's poses that has the lowest cost."""
        return min((row for row, one in enumerate(self.candidates) if one.holds_poses), key=self.px)


class _Weighing:
    """The candidates so far; each new one is a step, and one whose adjustment fails is a note."""

    def __init__(self, inputs: Sequence[TrackedModel], start: TrackedModel, steps: Steps) -> None:
        self._inputs, self._steps = [model.quality for model in inputs], steps
        self.candidates, self.notes = [Candidate(GIVEN, start, holds_poses=True)], list[str]()
        self._known = start.known_positions
        self.update()

    def update(self) -> None:
        self.inputs, *self.costs = costs(self._inputs, [one.model.quality for one in self.candidates])

    @property
    def best(self) -> int:
        return best(self.costs)

    @property
    def is_settled(self) -> bool:
        """Whether nothing is left to explain, or two ways came to one optimum."""
        lowest = self.costs[self.best]
        same = [cost for cost in self.costs[1:] if cost.px <= (1 + SAME_COST) * lowest.px]
        return lowest.is_sound or (len(same) > 1 and not lowest.images_off)

    def add(
        self,
        name: str,
        model: TrackedModel,
        poses: Floats | None = None,
        priors: PositionPriors | None = None,
        *,
        move_bodies: bool = True,
    ) -> None:
        try:
            found = self._steps.step(adjusted_model, model, poses, priors or self._known, move_bodies, title=name)
        except SourceError as error:
            self.notes.append(f"{name}: {error}")
            return
        adjusted = model.read_back(found.folder, found.notes)
        self._steps.remember(adjusted, self._steps.key(found))
        self.candidates.append(Candidate(name, adjusted, holds_poses=not move_bodies))
        self.update()


def weigh(
    inputs: Sequence[TrackedModel],
    start: TrackedModel,
    options: ModelRefinement,
    steps: Steps,
    workers: Workers,
    is_metric: bool,
) -> Found:
    """Make candidates, the cheapest first, until nothing is left that another could explain.

    Depth takes part where the model is in metres: else its clouds are in another unit, or not of these images.
    """
    weighing, plain, plainly = _Weighing(inputs, start, steps), start, 0
    weighing.add(POINTS, start, start.world_from_body, move_bodies=False)
    weighing.add(ADJUSTED, start)
    if not weighing.costs[0].is_sound:
        weighing.add(REPLACED, start, start.world_from_body)
        poses = steps.step(resected_poses, start, None, title="resection").poses
        weighing.add(RESECTED, start, poses)
        if not weighing.costs[weighing.best].is_sound:
            plainly = len(weighing.candidates)
            key, start = steps.key([start, ROBUST]), start.with_robust_loss()
            steps.remember(start, key)
            weighing.add(ROBUST_POINTS, start, start.world_from_body, move_bodies=False)
            weighing.add(ROBUST, start, poses)
    depth = depth_edges(start, options, steps, workers) if is_metric else no_depth_edges(start)
    solved = None
    if not weighing.is_settled or start.held_apart or depth.graph.edge_count:
        solved = _consistent(weighing, start, depth, options, steps)
    _mend(weighing, steps)
    if start is not plain:
        weighing.add(AFTER_ROBUST, plain, weighing.candidates[weighing.best].model.world_from_body)
        added = weighing.candidates[-1].name == AFTER_ROBUST
        if added and weighing.costs[-1].is_sound:  # the tracks were right: all of what they say counts
            weighing.candidates[plainly:-1] = []
            weighing.update()
    notes = (*depth.notes, *weighing.notes)
    return Found(weighing.inputs, weighing.candidates, weighing.costs, solved, depth, notes)


def _consistent(
    weighing: _Weighing, start: TrackedModel, depth: DepthEdges, options: ModelRefinement, steps: Steps
) -> Solved | None:
    """The solve of all edges, whose poses become a candidate."""
    measured, left_out = steps.step(measured_edges, start, title="edges")
    weighing.notes += left_out
    graph = ViewGraph.joined([measured, depth.graph])
    if not graph.edge_count:
        weighing.notes.append(NO_EDGE)
        return None
    solved = solve_bodies(graph, start.world_from_body, options.solver)
    weighing.notes += solved.solution.notes
    if not solved.kept.any():
        weighing.notes.append(NO_EDGE_LEFT)
        return solved
    with_depth = bool((solved.kept & (solved.graph.source == "depth")).any())
    priors = position_priors(solved) if with_depth else None
    weighing.add(CONSISTENT, start, solved.solution.world_from_cam, priors)
    return solved


def _mend(weighing: _Weighing, steps: Steps) -> None:
    """The best so far, with the images that are off placed anew by the points that the others hold."""
    for _ in range(MENDINGS):
        at = weighing.best
        off = weighing.costs[at].images_in_doubt if at else ()
        if not off:
            return
        model = weighing.candidates[at].model
        names = np.array([str(frame.frame_id) for frame in model.frames])
        bodies = np.zeros(len(model.body_names), bool)
        bodies[model.body_of_frame[np.isin(names, off)]] = True
        poses = steps.step(resected_poses, model, bodies, title="resection").poses
        weighing.add(MENDED, model, poses)
        if weighing.best == at:
            return


@dataclass(frozen=True)
class BodyPoses:
    """Poses (B, 4, 4) of a model's bodies."""

    poses: Floats


def resected_poses(model: TrackedModel, bodies: Bools | None, *, step: Step) -> BodyPoses:
    """Step: where the points put these bodies."""
    return BodyPoses(model.resected(bodies))


def measured_edges(model: TrackedModel, *, step: Step) -> tuple[ViewGraph, tuple[str, ...]]:
    """Step: the model's edges from what its images share, and what was left out."""
    return model.measured()


@dataclass(frozen=True)
class AdjustedModel:
    """A folder with what bundle adjustment wrote, and remarks."""

    folder: Path
    notes: tuple[str, ...]


def adjusted_model(
    start: TrackedModel, poses: Floats | None, priors: PositionPriors | None, move_bodies: bool = True, *, step: Step
) -> AdjustedModel:
    """Step: the bundle adjustment from the model's own poses or from these, with points that a match calls one merged.

    What it brings together can be merged after it, and is then adjusted once more. Where bodies are not to move, points
    alone are adjusted, and none is merged.
    """
    if poses is not None and not move_bodies:
        return _written(start.moved(poses).adjusted(priors, move_bodies=False), step)
    model = start if poses is None else start.moved(poses).merged()
    adjusted = model.adjusted(priors)
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
    return AdjustedModel(folder, tuple(adjusted.notes))
