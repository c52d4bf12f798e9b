"""What the alignment of a scene works with, in arrays: made once, used by every run."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hodge_pipeline.diagnosis.noise import Noise
from hodge_pipeline.types import Bools, Floats, Ints

LARGEST_EXHAUSTIVE = 400
EXHAUSTIVE_FROM = 0.1


@dataclass(frozen=True)
class Evidence:
    """Edges between recentred frames, and what is known of them before any alignment.

    - `i_from_j (E, 4, 4)`: at the working point; `prior (E,)`: probability by order; `noise`: of each edge.
    - `support (E,)`: how many cycles close over the edge, whose edges are likely right.
    - `alone (E,)`: edges in no cycle.
    - `reach_m`: how far overlapping views lie apart; `exhaustive`: whether every pair seems to have been tried.
    """

    edges: Ints
    vertex_count: int
    i_from_j: Floats
    prior: Floats
    noise: Noise
    support: Floats
    alone: Bools
    reach_m: float
    exhaustive: bool


def seems_exhaustive(edges: Ints, vertex_count: int) -> bool:
    """Whether far pairs are joined so often that a missing edge says something."""
    if not 2 < vertex_count <= LARGEST_EXHAUSTIVE:
        return False
    low, high = np.sort(edges, axis=1).T
    joined = len(np.unique((low * vertex_count + high)[low != high]))
    return joined >= EXHAUSTIVE_FROM * vertex_count * (vertex_count - 1) / 2
