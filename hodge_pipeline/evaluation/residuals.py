"""Residuals of measured edges at given poses."""

from __future__ import annotations

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.types import Edges, Floats, ViewGraph
from hodge_pipeline.types.edges import DISABLED, IGNORED, USED


def edge_residuals(graph: ViewGraph, world_from_cam: Floats) -> tuple[Floats, Floats]:
    """Translation (E,) in metres and angle (E,) in radians of `Z_ij⁻¹ T_i⁻¹ T_j`, the residual motion in j's axes.

    T is `world_from_cam (V, 4, 4)`, Z the edge's `i_from_j`. NaN where either pose is not finite.
    """
    first, second = world_from_cam[graph.edges[:, 0]], world_from_cam[graph.edges[:, 1]]
    left_over = se3.inverse(graph.i_from_j) @ se3.inverse(first) @ second
    known = np.asarray(np.isfinite(left_over).all(axis=(-1, -2)))
    translation_m, angle_rad = np.full(len(known), np.nan), np.full(len(known), np.nan)
    translation_m[known] = np.linalg.norm(left_over[known, :3, 3], axis=-1)
    angle_rad[known] = se3.rotation_angle(left_over[known])
    return translation_m, angle_rad


def with_residuals(edges: Edges, world_from_cam: Floats, weights: Floats) -> Edges:
    """The table with weight, residual and status of its G edges in the graph, by poses (V, 4, 4) and `weights (G,)`."""
    rows = np.flatnonzero(edges.in_graph)
    graph = edges.as_graph(np.arange(len(world_from_cam)), rows)
    translation_m, angle_rad = edge_residuals(graph, world_from_cam)
    status = np.where(edges.status[rows] == DISABLED, DISABLED, np.where(weights > 0, USED, IGNORED))
    unsolved = edges.put(slice(None), weight=np.nan, residual_m=np.nan, residual_rad=np.nan)
    return unsolved.put(rows, weight=weights, residual_m=translation_m, residual_rad=angle_rad, status=status)
