"""Which motions of a frame no edge measures: along a bare wall it slides, and every solver leaves it where it was."""

from __future__ import annotations

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.complex.chi2 import has_unit_information
from hodge_pipeline.types import Floats, ViewGraph
from hodge_pipeline.types.text import counted

KINDS = ("turning about", "sliding along")
UNMEASURED = 1e-6
"""Share of a frame's largest eigenvalue (a standard deviation 1000 times as large): a motion that nothing measures."""
NAMED = 5
"""Frames in a note."""


def named_direction(vector: Floats) -> str:
    """The larger part of a motion (6,), rotation or translation, in words: sliding along (0.00, 1.00, 0.00)."""
    turning, sliding = vector[:3], vector[3:]
    which = int(np.linalg.norm(sliding) > np.linalg.norm(turning))
    axis = (turning, sliding)[which]
    axis = axis / np.linalg.norm(axis) * (1 if axis[np.abs(axis).argmax()] > 0 else -1)
    return f"{KINDS[which]} ({', '.join(f'{x:.2f}' for x in np.round(axis, 2) + 0.0)})"


def free_direction_notes(graph: ViewGraph) -> tuple[str, ...]:
    """A line that names frames which can move, in their own axes, without any edge's residual changing; none if none.

    Frames without an edge are not named, nor those of a graph in the plane or one that states no information.
    """
    if graph.dimension == 2 or not graph.edge_count or has_unit_information(graph):
        return ()
    held = _held(graph)
    turns, slides = (np.einsum("vii->v", held[:, part, part]) for part in (slice(3), slice(3, 6)))
    both = (turns > 0) & (slides > 0)
    arm_m = float(np.sqrt(np.median(turns[both] / slides[both]))) if both.any() else 1.0
    scale = np.repeat([1 / arm_m, 1.0], 3)  # a turn then counts as the slide that is known as well
    held = scale[:, None] * held * scale
    values, vectors = np.linalg.eigh(held)
    free = (values < UNMEASURED * values[:, -1:]) & (values[:, -1:] > 0)
    frames = np.flatnonzero(free.any(axis=1))
    if not len(frames):
        return ()
    named = [
        f"{graph.vertex_ids[k]} ({'; '.join(named_direction(vector) for vector in vectors[k].T[free[k]])})"
        for k in frames[:NAMED]
    ]
    more = f", {len(frames) - NAMED} more" if len(frames) > NAMED else ""
    whose = f"{counted(len(frames), 'frame')}, in their axes: {', '.join(named)}{more}"
    return (f"no edge measures these motions of {whose}",)


def _held(graph: ViewGraph) -> Floats:
    """The information (V, 6, 6) of all edges on each frame's own motion."""
    held = np.zeros((graph.vertex_count, 6, 6))
    np.add.at(held, graph.edges[:, 1], graph.information)
    np.add.at(held, graph.edges[:, 0], se3.pull_back(se3.inverse(graph.i_from_j), graph.information))
    return held
