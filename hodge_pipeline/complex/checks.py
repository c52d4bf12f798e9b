"""Checks of a graph that every solver makes before it computes anything."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.complex.coboundary import check_edges
from hodge_pipeline.errors import GraphError
from hodge_pipeline.types import Floats, Ints, ViewGraph

NEARLY_ORTHONORMAL = 1e-12
"""Rounding leaves 1e-15; rotations nearer than this stay as they are, to the last bit."""
NO_EDGES = "no edge joins two vertices: every pose is as it was at the start"


def check_graph(graph: ViewGraph, world_from_cam: Floats | None = None) -> None:
    """Raises `GraphError` that names the first vertex or edge whose shape or numbers cannot be used.

    Motions need only be as rigid as real files hold them (`se3.is_motion`): solvers take the nearest rotations.
    """
    count = graph.vertex_count
    if count == 0:
        raise GraphError("the graph has no vertices: nothing was read, or every frame was rejected")
    if world_from_cam is not None and world_from_cam.shape != (count, 4, 4):
        raise GraphError(f"poses have the shape {world_from_cam.shape}, but {count} vertices need ({count}, 4, 4)")
    shapes = {"edges": (2,), "i_from_j": (4, 4), "information": (6, 6)}
    for name, shape in shapes.items():
        given = getattr(graph, name).shape
        if given != (graph.edge_count, *shape):
            raise GraphError(f"{name} has the shape {given}, expected {(graph.edge_count, *shape)}")
    check_edges(graph.edges, count)
    check_fixed(graph.fixed, count)
    if world_from_cam is not None:
        ids = graph.vertex_ids
        check_motions(world_from_cam, "poses", lambda row: f"the start pose of vertex {ids[row]}")
    check_motions(graph.i_from_j, "edges", lambda row: f"{_edge(graph, row)}: its measurement i_from_j")
    wrong = ~np.isfinite(graph.information).all(axis=(1, 2))
    if wrong.any():
        named = f"{_edge(graph, int(np.argmax(wrong)))}: its information is not finite"
        raise GraphError(f"{named} ({int(wrong.sum())} such edges): remove or mend it")


def refuse_priors(graph: ViewGraph, solver: str) -> None:
    """Raises `GraphError` where the graph has priors, for a solver that has no term for them."""
    if graph.priors is not None and len(graph.priors.vertices):
        count = len(graph.priors.vertices)
        raise GraphError(
            f"{solver} has no term for priors of single poses ({count} given): take solver maximum_likelihood or "
            "robust, or leave them out (priors=None)"
        )


def check_motions(motions: Floats, kind: str, name: Callable[[int], str]) -> None:
    """Raises `GraphError` with what is wrong with the first of the motions (N, 4, 4) that is not finite and rigid.

    `name` gives the name of a row, `kind` the plural of what the rows are.
    """
    wrong = ~se3.is_motion(motions)
    if wrong.any():
        row = int(np.argmax(wrong))
        raise GraphError(f"{name(row)} {_fault(motions[row])} ({int(wrong.sum())} such {kind})")


def check_fixed(rows: Ints, vertex_count: int) -> None:
    """Raises `GraphError` where one of the rows of fixed vertices is outside 0 … V − 1, or they are a mask."""
    if rows.dtype == bool:
        raise GraphError("fixed is a mask: give the rows, as np.flatnonzero makes them")
    outside = (rows < 0) | (rows >= vertex_count)
    if outside.any():
        raise GraphError(
            f"fixed names vertex row {rows[np.argmax(outside)]}, but the graph has {vertex_count} vertices: "
            f"give rows from 0 to {vertex_count - 1}, not the vertices' ids"
        )


def _edge(graph: ViewGraph, row: int) -> str:
    i, j = graph.vertex_ids[graph.edges[row]]
    return f"edge {row} (vertices {i}, {j})"


def _fault(matrix: Floats) -> str:
    """What is wrong with a matrix (4, 4) that is no motion, and what to do."""
    if not (np.abs(matrix) < se3.MAX_NUMBER).all():
        return f"is not finite, or holds a number past {se3.MAX_NUMBER:g}: remove or mend it"
    if se3.is_motion(matrix.T):
        return "looks transposed: its last row carries the translation; pass the matrices transposed"
    mirrored = np.array(matrix)
    mirrored[:3, 0] *= -1
    if se3.is_motion(mirrored):
        return "is mirrored (determinant -1), no rotation: convert both poses from left-handed axes first"
    return "is not rigid: its rotation is not orthonormal, or its last row is not 0 0 0 1; remove or mend it"


def orthonormal(b_from_a: Floats) -> Floats:
    """The motions (N, 4, 4) with each rotation replaced by the nearest one, where it is not exact already."""
    rotation = b_from_a[:, :3, :3]
    error = np.abs(np.swapaxes(rotation, -1, -2) @ rotation - np.eye(3)).max(axis=(-1, -2))
    rows = np.flatnonzero(error > NEARLY_ORTHONORMAL)
    out = np.array(b_from_a, float)
    out[rows, :3, :3] = se3.project_to_so3(rotation[rows])
    return out
