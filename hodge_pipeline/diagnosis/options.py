"""Options of the diagnosis; the defaults serve every scene."""

from __future__ import annotations

from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from hodge_pipeline.solvers.backbone.bridged import MOST_BREAKS
from hodge_pipeline.solvers.backbone.trust import AUTO

CONSISTENT_FROM = 0.7
"""Probability from which an edge is consistent: a wrong one kept costs as much as two or three right ones lost."""
WRONG_BELOW = 0.2
"""Probability below which an edge is wrong, not suspect."""


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class DiagnosisOptions:
    """How edges are weighed against each other."""

    trust: str = Field(
        default=AUTO,
        min_length=1,
        description="edges that are trusted as a backbone: auto learns from the graph whether consecutive edges are "
        "one; sequential trusts these, none no edge; any other word the edges that come from it (`proposed_by`)",
    )
    most_breaks: int = Field(
        default=MOST_BREAKS,
        ge=0,
        le=MOST_BREAKS,
        description="edges of a backbone that loops may call wrong, as where a robot was carried on unnoticed; 0 where "
        "odometry notices that itself, so that two places alike never outweigh it",
    )
    order_prior: bool = Field(
        default=True,
        description="learn from the graph whether vertices that are near in order are more often joined, and expect "
        "such edges to be right more often; none is trusted",
    )
