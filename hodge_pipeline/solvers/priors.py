"""Unary pose priors: each is an edge from the world, one more vertex that is held at the identity."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from hodge_pipeline.complex.checks import check_motions
from hodge_pipeline.complex.components import by_size
from hodge_pipeline.errors import GraphError
from hodge_pipeline.types import Floats, Ints, Priors, Solution, ViewGraph

SOURCE = "prior"
"""The `source` of the edges from the world."""
PER_EDGE = ("edges", "i_from_j", "information", "fitness", "rmse_m", "source", "correspondences")
"""The columns of a graph with one row for each edge."""


def with_world(graph: ViewGraph, priors: Priors, start: Floats | None, fixed: Ints | None) -> tuple[ViewGraph, Floats]:
    """The graph with the world as its last vertex, held at the identity, and start poses (V + 1, 4, 4).

    Without a start every vertex begins at the world's origin, which only a descent from given poses would heed.
    Raises `GraphError` where a prior names no vertex, or holds no motion.
    """
    vertices, count = np.asarray(priors.vertices, np.int64), graph.vertex_count
    outside = (vertices < 0) | (vertices >= count)
    if outside.any():
        raise GraphError(
            f"prior {np.argmax(outside)} names vertex row {vertices[np.argmax(outside)]} of {count}: mend it"
        )
    names = graph.vertex_ids[vertices]
    check_motions(priors.world_from_vertex, "priors", lambda row: f"prior {row} (vertex {names[row]})")
    added = ViewGraph.from_edges(
        np.arange(count + 1),
        np.column_stack([np.full(len(vertices), count), vertices]),
        priors.world_from_vertex,
        np.asarray(priors.information, float).reshape(-1, 6, 6),
        SOURCE,
    )
    held = np.zeros(0, np.int64) if start is None else graph.fixed if fixed is None else np.asarray(fixed, np.int64)
    joined: dict[str, Any] = {name: np.concatenate([getattr(graph, name), getattr(added, name)]) for name in PER_EDGE}
    whole = replace(
        added,
        vertex_ids=np.append(graph.vertex_ids, np.asarray([_unused(graph)], graph.vertex_ids.dtype)),
        **joined,
        dimension=graph.dimension,
        fixed=np.append(held, count),
    )
    poses = np.tile(np.eye(4), (count + 1, 1, 1))
    if start is not None:
        poses[:count] = start
    return whole, poses


def _unused(graph: ViewGraph) -> object:
    """An id for the world that looks like the others; it is shown in messages only."""
    if graph.vertex_ids.dtype.kind not in "iu" or not graph.vertex_count:
        return 0
    return int(graph.vertex_ids.max()) + 1


def without_world(solution: Solution, graph: ViewGraph) -> Solution:
    """The solution of the graph alone; the components are those that edges and priors together join."""
    history = tuple(replace(step, world_from_cam=step.world_from_cam[:-1]) for step in solution.history)
    return replace(
        solution,
        world_from_cam=solution.world_from_cam[:-1],
        component=by_size(solution.component[:-1]),
        weights=solution.weights[: graph.edge_count],
        history=history,
    )
