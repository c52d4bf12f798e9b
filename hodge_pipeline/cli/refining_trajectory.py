"""`hodge refine trajectory`: the recipe `slam-refine` on given poses and frames."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from hodge_pipeline.errors import RecipeError


def refine(
    poses: Path,
    frames: Path,
    out: Path,
    match: str,
    overrides: Sequence[str],
    *,
    force: bool,
    overwrite: bool,
    quiet: bool,
    as_json: bool,
) -> None:
    """Run the recipe and print what came out."""
    raise RecipeError("refine trajectory: not finished yet")
