"""What every solver asks of a graph before it computes anything."""

from __future__ import annotations

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.complex.coboundary import check_edges
from hodge_pipeline.errors import GraphError
from hodge_pipeline.types import Bools, Floats, ViewGraph

NEARLY_ORTHONORMAL = 1e-12


def check_graph(graph: ViewGraph, world_from_cam: Floats) -> None:
    """Raises `GraphError` that names the first vertex or edge whose shape or numbers cannot be used."""
    count = graph.vertex_count
    if count == 0:
        raise GraphError("the graph has no vertices: nothing was read, or every frame was rejected")
    if world_from_cam.shape != (count, 4, 4):
        raise GraphError(f"poses have the shape {world_from_cam.shape}, but {count} vertices need ({count}, 4, 4)")
    shapes = {"edges": (2,), "i_from_j": (4, 4), "information": (6, 6)}
    for name, shape in shapes.items():
        given = getattr(graph, name).shape
        if given != (graph.edge_count, *shape):
            raise GraphError(f"{name} has the shape {given}, expected {(graph.edge_count, *shape)}")
    check_edges(graph.edges, count)
    bad_pose = np.flatnonzero(~se3.is_motion(world_from_cam))
    if len(bad_pose):
        name = graph.vertex_ids[bad_pose[0]]
        raise GraphError(f"the start pose of vertex {name} is not a rigid motion ({len(bad_pose)} such poses)")
    _refuse(graph, ~se3.is_motion(graph.i_from_j), "its motion is not rigid and finite")
    _refuse(graph, np.asarray(~np.isfinite(graph.information).all(axis=(1, 2))), "its information is not finite")


def _refuse(graph: ViewGraph, bad: Bools, reason: str) -> None:
    rows = np.flatnonzero(bad)
    if len(rows):
        i, j = graph.vertex_ids[graph.edges[rows[0]]]
        raise GraphError(f"edge {rows[0]} (vertices {i}, {j}): {reason} ({len(rows)} such edges): remove or mend it")


def orthonormal(b_from_a: Floats) -> Floats:
    """The motions (N, 4, 4) with each rotation replaced by the nearest one, where it is not exact already."""
    rotation = b_from_a[:, :3, :3]
    error = np.abs(np.swapaxes(rotation, -1, -2) @ rotation - np.eye(3)).max(axis=(-1, -2))
    rows = np.flatnonzero(error > NEARLY_ORTHONORMAL)
    out = np.array(b_from_a, float)
    out[rows, :3, :3] = se3.project_to_so3(rotation[rows])
    return out
