"""Options of a round: what it is solved with, and the pairs that it registers because the diagnosis suggests them."""

from __future__ import annotations

from typing import Literal, TypeAlias

from pydantic import Field
from pydantic.dataclasses import dataclass

from hodge_pipeline.pairs.overlap import OverlapEdges
from hodge_pipeline.stages import OPTIONS, EdgeBuilder

SolveWith: TypeAlias = Literal["all", "kept"]
"""The edges that a round is solved with: all that were accepted, or of these what the diagnosis keeps."""


@dataclass(frozen=True, config=OPTIONS)
class SuggestionOptions:
    """Pairs that the diagnosis suggests, registered as well: what tests an edge, joins pieces, holds what is loose."""

    rounds: int = Field(
        default=0,
        ge=0,
        le=20,
        description="rounds after the outer iterations, each: diagnose, register the most informative pairs, solve "
        "with them; they end early once no pair is worth it. 0: none are registered, `hodge diagnose` names them",
    )
    pairs: int = Field(default=40, ge=1, description="pairs that a round registers at most, no frame in more than two")
    min_gain: float = Field(
        default=0.5,
        ge=0,
        description="nats: what a pair must gain, as log(1 + resistance) of the kept edges between its frames, and 1 "
        "more for each untestable edge that it tests; 0.5 takes 39 % of the variance between its frames away",
    )
    among: EdgeBuilder = Field(
        default=OverlapEdges(min_iou=0.2, voxel_m=0.1),
        description="the pairs of one piece that may be registered: those that see something in common",
    )
