"""What a recording keeps, and how large it may become: the recipe's section `recording`."""

from __future__ import annotations

from typing import Literal

from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

Level = Literal["off", "summary", "normal", "full"]

SHARES = {"images": 0.85, "clouds": 0.04, "model": 0.07, "solver": 0.04}
"""Shares of the stages in `max_megabytes`: fixed, so that the part of one does not depend on the others."""


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class RecordingOptions:
    """What the recording keeps. Whatever is thinned is thinned evenly, and said in the recording's log."""

    level: Level = Field(
        default="normal",
        description="off: no recording; summary: no images, clouds or solver film; normal: all, thinned to what a "
        "viewer shows with ease; full: all, thinned only where max_megabytes asks for it",
    )
    max_megabytes: float = Field(
        default=100.0,
        gt=0,
        description="10^6 bytes: bound on the file; 85 % of it for images, the rest for clouds, model and solver; 100 "
        "holds 650 VGA colour and depth images",
    )

    def max_bytes(self, stage: str) -> int:
        """The bytes that a stage of `SHARES` may take."""
        return int(SHARES[stage] * self.max_megabytes * 1e6)

    def count(self, wished: int, available: int, bytes_each: float, max_bytes: float) -> int:
        """How many of the available items to keep: as wished, of level `full` all, and always within the bytes."""
        kept = available if self.level == "full" else min(available, wished)
        return min(kept, int(max_bytes // bytes_each))

    @property
    def has_images(self) -> bool:
        """Whether images, clouds and the solver's film are kept."""
        return self.level in ("normal", "full")
