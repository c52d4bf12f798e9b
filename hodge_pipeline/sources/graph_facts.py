"""What a measured graph is like: its size, pieces, cycles and information, and what is odd about it."""

from __future__ import annotations

from collections import Counter
from typing import Any

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.complex.cech import clique_counts
from hodge_pipeline.complex.components import connected_components
from hodge_pipeline.complex.holes import unfilled_loops
from hodge_pipeline.sources.frame_facts import LISTED, METRES, listed
from hodge_pipeline.types import Bools, Floats, Ints, ViewGraph
from hodge_pipeline.types.text import counted

MOST_TRIANGLES = 20_000
"""Elimination takes seconds beyond."""
INDEFINITE = 1e-9
"""Of the largest eigenvalue: a more negative one is not rounding."""


def graph_facts(graph: ViewGraph, oddities: list[str], unit: str = METRES) -> dict[str, Any]:
    """Facts of a graph, whose lengths have a `unit`, as plain data; what is odd is added to the list."""
    rows, count = graph.edges, graph.vertex_count
    between = rows[rows[:, 0] != rows[:, 1]]
    simple = np.unique(np.sort(between, axis=1), axis=0)
    component = connected_components(simple, count)
    sizes = np.bincount(component)
    degree = np.bincount(simple.ravel(), minlength=count)
    repeats = np.unique(np.sort(between, axis=1), axis=0, return_counts=True)[1]
    _note_shape(graph, len(between) - len(simple), sizes, degree, oddities)
    facts: dict[str, Any] = {
        "vertices": count,
        "edges": graph.edge_count,
        "dimension": graph.dimension,
        "edges by source": dict(sorted(Counter(graph.source.tolist()).items())),
        "connected components": len(sizes),
        "vertices of the largest": sizes[:LISTED].tolist(),
        "isolated vertices": int((degree == 0).sum()),
        "degree, least median most": [int(degree.min()), float(np.median(degree)), int(degree.max())],
        "pairs with more than one edge": int((repeats > 1).sum()),
        **_cycle_facts(simple, count, len(sizes)),
    }
    if len(graph.fixed):
        facts["fixed vertices"] = len(graph.fixed)
    if graph.edge_count:
        facts.update(_motion_facts(graph, oddities, unit))
        facts.update(_information_facts(graph, oddities))
    return facts


def _cycle_facts(simple: Ints, vertices: int, pieces: int) -> dict[str, Any]:
    """Independent cycles are b1 of the graph itself; those that triangles leave open, b1 of its flag complex."""
    facts: dict[str, Any] = {"independent cycles": len(simple) - vertices + pieces}
    triangles = clique_counts(simple, vertices)[2] if len(simple) else 0
    facts["triangles"] = triangles
    if triangles <= MOST_TRIANGLES:
        facts["cycles that no triangles fill (b1)"] = unfilled_loops(simple, vertices, most_loops=0).count
    return facts


def _motion_facts(graph: ViewGraph, oddities: list[str], unit: str) -> dict[str, Any]:
    sound = se3.is_motion(graph.i_from_j)
    _note_edges(graph, ~sound, "no rigid motion", oddities)
    if not sound.any():
        return {}
    translation_m = np.linalg.norm(graph.i_from_j[sound, :3, 3], axis=1)
    angle_deg = np.rad2deg(se3.rotation_angle(graph.i_from_j[sound]))
    return {
        f"edge translation in {unit}, median largest": [float(np.median(translation_m)), float(translation_m.max())],
        "edge rotation in degrees, median largest": [float(np.median(angle_deg)), float(angle_deg.max())],
    }


def _information_facts(graph: ViewGraph, oddities: list[str]) -> dict[str, Any]:
    information = graph.information
    finite = np.asarray(np.isfinite(information).all(axis=(1, 2)))
    _note_edges(graph, ~finite, "information that is not finite", oddities)
    values = np.linalg.eigvalsh(np.where(finite[:, None, None], information, 0.0))
    largest = np.abs(values).max(axis=1)
    _note_edges(graph, values[:, 0] < -INDEFINITE * largest, "indefinite information", oddities)
    _note_edges(graph, finite & (largest == 0), "no information at all", oddities)
    if (information == np.eye(6)).all():
        return {"information": "the identity for every edge"}
    in_plane = np.array([2, 3, 4]) if graph.dimension == 2 else np.arange(6)
    diagonal = np.diagonal(information, axis1=1, axis2=2)[finite][:, in_plane]
    cut = 1 if graph.dimension == 2 else 3
    return {
        "information of rotation, least median most": _spread(diagonal[:, :cut]),
        "information of translation, least median most": _spread(diagonal[:, cut:]),
    }


def _spread(values: Floats) -> list[float] | None:
    return [float(f"{find(values):.6g}") for find in (np.min, np.median, np.max)] if values.size else None


def _note_shape(graph: ViewGraph, parallel: int, sizes: Ints, degree: Ints, oddities: list[str]) -> None:
    loops = graph.edges[:, 0] == graph.edges[:, 1]
    _note_edges(graph, loops, "both ends at one vertex", oddities)
    alone = graph.vertex_ids[degree == 0]
    if len(alone):
        oddities.append(f"{len(alone)} of {graph.vertex_count} vertices have no edge: {listed(alone.tolist())}")
    pieces = int((sizes > 1).sum())
    if pieces > 1:
        oddities.append(f"the graph falls into {pieces} pieces with edges: each has a gauge of its own")
    if parallel and parallel < 0.5 * graph.edge_count:
        oddities.append(f"{counted(parallel, 'edge repeats|edges repeat')} a pair that has one already")


def _note_edges(graph: ViewGraph, wrong: Bools, what: str, oddities: list[str]) -> None:
    if wrong.any():
        pairs = [f"{graph.vertex_ids[i]}-{graph.vertex_ids[j]}" for i, j in graph.edges[wrong]]
        oddities.append(f"{len(pairs)} of {graph.edge_count} edges have {what}: {listed(pairs)}")
