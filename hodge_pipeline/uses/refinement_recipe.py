"""Which recipe refines given poses, by the frames they are of."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from hodge_pipeline.sources.inspect import guess_reader, guesses
from hodge_pipeline.types import Frame, Source

RECIPE, SCANS = "slam_refine", "slam_refine_scans"
CALIBRATED = {"tum": "slam_refine_tum"}
"""Recipes for the readers of formats whose depth and colour are calibrated to each other, where landmarks measure."""


def recipe_for(frames: Path, source: Source | None = None) -> str:
    """The name of the recipe that refines poses of these frames, by their format, or by what their frames hold.

    `source`: the opened frames, if they are open already.
    """
    found = guesses(frames) if frames.exists() else []
    if not found:
        return RECIPE
    if found[0].name in CALIBRATED:
        return CALIBRATED[found[0].name]
    return recipe_of((source or guess_reader(frames, found).open(frames)).frames)


def recipe_of(frames: Sequence[Frame]) -> str:
    """The recipe that refines poses of these frames in memory."""
    has_scans = any(frame.read_points is not None for frame in frames)
    return SCANS if has_scans and all(frame.camera is None for frame in frames) else RECIPE
