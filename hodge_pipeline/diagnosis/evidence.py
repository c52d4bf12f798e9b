"""The inputs of an alignment, in arrays."""

from __future__ import annotations

from dataclasses import dataclass

from hodge_pipeline.diagnosis.noise import Noise
from hodge_pipeline.types import Bools, Floats, Ints


@dataclass(frozen=True)
class Evidence:
    """Edges between recentred frames, and what can be computed of them before any alignment.

    - `i_from_j (E, 4, 4)`: at the working point; `prior (E,)`: probability of being right by the order of the views;
      `noise`: of each edge.
    - `support (E,)`: how many cycles close over the edge, whose edges are likely right.
    - `in_no_listed_cycle (E,)`: edges that no listed cycle passes.
    - `exhaustive`: whether registration seems to have been tried on all pairs.
    - `reach_m`: how far overlapping views lie apart.
    """

    edges: Ints
    vertex_count: int
    i_from_j: Floats
    prior: Floats
    noise: Noise
    support: Floats
    in_no_listed_cycle: Bools
    exhaustive: bool
    reach_m: float
