"""Edges between a model's bodies by depth: overlapping clouds registered, some pairs held out to judge by."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.evaluation.scores import edge_distances
from hodge_pipeline.refine.model_options import ModelRefinement
from hodge_pipeline.registration.cloud_set import prepare_clouds
from hodge_pipeline.registration.clouds import CloudOptions
from hodge_pipeline.registration.register import register_edges
from hodge_pipeline.stages import Step, Steps, Workers
from hodge_pipeline.store.codec import CLOUDS
from hodge_pipeline.types import Bools, CloudSet, Edges, Floats, Ints, ViewGraph
from hodge_pipeline.types.text import counted
from hodge_pipeline.types.tracked_model import TrackedModel

PAIRS_HELD_OUT, LEAST_HELD_OUT = 0.2, 4
"""Share of the pairs with depth that no registration or solve sees, and how few are too few to judge by."""


@dataclass(frozen=True)
class DepthEdges:
    """Registered edges between bodies, and what judges a result by depth.

    `images (D,)`: rows of the model's images with depth, whose `clouds` are in the same order; `held_out (H, 2)`: pairs
    of rows of these D.
    """

    graph: ViewGraph
    held_out: Ints
    images: Ints
    clouds: CloudSet | None
    notes: tuple[str, ...]


def depth_edges(model: TrackedModel, options: ModelRefinement, steps: Steps, workers: Workers) -> DepthEdges:
    """Edges between the images that have depth, of a model in metres; none of fewer than two images.

    Pairs are proposed and registered from the model's own poses, so depth alone closes no drift beyond the registrar's
    reach.
    """
    images = np.array([row for row, frame in enumerate(model.frames) if frame.read_depth is not None], np.int64)
    if len(images) < 2:
        return no_depth_edges(model)
    frames = [model.frames[row] for row in images]
    poses = np.array([frame.world_from_cam for frame in frames])
    clouds, notes = steps.step(depth_clouds, model, images, options.clouds, title="clouds", workers=workers)
    steps.remember(clouds, steps.key([steps.key(model), images, options.clouds]))
    candidates = options.edges.propose(frames, clouds, poses)
    body = model.body_of_frame[images]
    between = body[candidates.pairs[:, 0]] != body[candidates.pairs[:, 1]]
    pairs = candidates.pairs[between]
    held = held_out(len(pairs), PAIRS_HELD_OUT, options.seed)
    chosen = Edges.of(pairs[~held], "depth")
    registered = steps.step(
        register_edges, chosen, clouds, options.registration, poses, title="registration", workers=workers
    )
    reasons = options.acceptance.reasons(registered)
    notes = (
        *notes,
        *(f"{counted((reasons == why).sum(), 'pair')} with depth left out: {why}" for why in np.unique(reasons) if why),
    )
    accepted = registered.select(reasons == "")
    names = np.array([str(frame.frame_id) for frame in frames])
    graph = accepted.as_graph(names)
    return DepthEdges(_between_bodies(model, graph, images), pairs[held], images, clouds, notes)


def depth_clouds(
    model: TrackedModel, images: Ints, options: CloudOptions, *, workers: Workers, step: Step
) -> tuple[CloudSet, tuple[str, ...]]:
    """Step: the clouds of the images (D,) with depth, and notes on odd ones."""
    frames = [model.frames[row] for row in images]
    clouds, notes = prepare_clouds(frames, options, workers, step.folder / CLOUDS, step.advance)
    return clouds, tuple(map(str, notes))


def held_out(count: int, share: float, seed: int) -> Bools:
    """Which (count,) of the pairs are held out: a random share, none where these would be too few to judge by."""
    chosen = np.zeros(count, bool)
    size = round(share * count)
    if size >= LEAST_HELD_OUT:
        chosen[np.random.default_rng(seed).permutation(count)[:size]] = True
    return chosen


def held_out_distances(edges: DepthEdges, pose_sets: Floats, workers: Workers) -> Floats:
    """Cloud distances (S, H) of the pairs held out under S sets of poses (S, N, 4, 4) of all images, metres."""
    if edges.clouds is None or not len(edges.held_out):
        return np.zeros((len(pose_sets), 0))
    return edge_distances(edges.clouds.folder, edges.held_out, pose_sets[:, edges.images], workers)


def no_depth_edges(model: TrackedModel) -> DepthEdges:
    """The edges of a model without depth: none, over its bodies."""
    none = np.zeros((0, 2), np.int64)
    graph = ViewGraph.from_edges(np.array(model.body_names), none, np.zeros((0, 4, 4)))
    return DepthEdges(graph, none, none[:, 0], None, ())


def _between_bodies(model: TrackedModel, graph: ViewGraph, images: Ints) -> ViewGraph:
    """Edges Z between cameras as edges `B_i Z B_j⁻¹` between bodies, B being body_from_cam; see `se3.pull_back`."""
    rows = images[graph.edges]
    cam_from_body = se3.inverse(model.body_from_cam[rows[:, 1]])
    return replace(
        graph,
        vertex_ids=np.array(model.body_names),
        edges=model.body_of_frame[rows].reshape(-1, 2),
        i_from_j=model.body_from_cam[rows[:, 0]] @ graph.i_from_j @ cam_from_body,
        information=se3.pull_back(cam_from_body, graph.information),
    )
