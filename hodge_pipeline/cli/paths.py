"""Checks of the paths of a command line."""

from __future__ import annotations

from pathlib import Path

from hodge_pipeline.errors import RecipeError


def keep_source(source: Path, out: Path) -> None:
    """Raise `RecipeError` where the result would be written over what is read: not every line of it may come back."""
    if out.is_file() and source.exists() and out.samefile(source):
        raise RecipeError(f"{out}: is what is read: give another path for the result")
