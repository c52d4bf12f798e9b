"""What the diagnosis can be told; the defaults serve every scene."""

from __future__ import annotations

from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class DiagnosisOptions:
    """How edges are weighed against each other."""

    runs: int = Field(
        default=8,
        gt=0,
        description="alignments of the scene from perturbed weights; an edge's probability counts its share",
    )
    edges_budget: int = Field(
        default=20_000, gt=0, description="runs × edges at most, so that large graphs take fewer runs (always one)"
    )
    perturbation: float = Field(
        default=0.7,
        ge=0,
        description="spread of the logarithm of the weights from run to run: wide enough to try other answers",
    )
    cluster_gain: float = Field(
        default=3.0,
        ge=0,
        description="nats that agreeing edges between two pieces add per e-fold of their number: they are one event, "
        "since places that look alike give many wrong edges that agree",
    )
    overlap_penalties: tuple[float, ...] = Field(
        default=(0.3, 1.0),
        description="tried in turn: weight of 'these two views lie upon each other and no edge says so', used only "
        "where every pair seems to have been tried",
    )
    every_pair_tried: bool | None = Field(
        default=None,
        description="whether every pair of views was tried, so that a missing edge speaks against an overlap; none: "
        "where a tenth of all pairs has an edge. A run's recipe says false, since it tries a few pairs to a frame",
    )
    order_prior: bool = Field(
        default=True,
        description="learn from the graph whether vertices that are near in order are more often joined, and expect "
        "such edges to be right more often; none is trusted",
    )
    max_cycles_per_edge: int = Field(
        default=64, gt=0, description="triangles kept to an edge, so that memory is bounded"
    )
    consistent_from: float = Field(default=0.5, gt=0, lt=1, description="probability from which an edge is consistent")
    wrong_below: float = Field(
        default=0.2, gt=0, lt=1, description="probability below which an edge is wrong, not suspect"
    )
    seed: int = Field(default=0, ge=0, description="of the perturbations")
