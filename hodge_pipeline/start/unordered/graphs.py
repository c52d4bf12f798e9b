"""Viewing graphs put together, and what is left of one when the diagnosis has spoken."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from hodge_pipeline.diagnosis.result import Diagnosis
from hodge_pipeline.types import Floats, Ints, ViewGraph

COLUMNS = ("edges", "i_from_j", "information", "fitness", "rmse_m", "source", "correspondences")


def joined_graph(first: ViewGraph, second: ViewGraph) -> ViewGraph:
    """The edges of both, between the same vertices."""
    columns: dict[str, Any] = {name: np.concatenate([getattr(first, name), getattr(second, name)]) for name in COLUMNS}
    return replace(first, **columns)


def without_wrong(graph: ViewGraph, diagnosis: Diagnosis) -> tuple[ViewGraph, Ints, Floats]:
    """The edges that the diagnosis keeps, the piece (V,) of each vertex, and its pose in the piece (V, 4, 4)."""
    return graph.select(diagnosis.kept), diagnosis.piece, diagnosis.world_from_cam
