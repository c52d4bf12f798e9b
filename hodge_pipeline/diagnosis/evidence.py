"""What the alignment of a scene works with, in arrays."""

from __future__ import annotations

from dataclasses import dataclass

from hodge_pipeline.diagnosis.noise import Noise
from hodge_pipeline.types import Bools, Floats, Ints


@dataclass(frozen=True)
class Evidence:
    """Edges between recentred frames, and what is known of them before any alignment.

    - `i_from_j (E, 4, 4)`: at the working point; `prior (E,)`: probability by order; `noise`: of each edge.
    - `support (E,)`: how many cycles close over the edge, whose edges are likely right.
    - `alone (E,)`: edges in no cycle.
    - `exhaustive`: whether registration seems to have been tried on all pairs.
    - `reach_m`: how far overlapping views lie apart.
    """

    edges: Ints
    vertex_count: int
    i_from_j: Floats
    prior: Floats
    noise: Noise
    support: Floats
    alone: Bools
    exhaustive: bool
    reach_m: float
