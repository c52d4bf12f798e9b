"""Checks of the paths of a command line."""

from __future__ import annotations

from pathlib import Path

from hodge_pipeline.errors import RecipeError


def keep_source(source: Path, out: Path) -> None:
    """Raise `RecipeError` where the result would be written over what is read: not every line of it may come back."""
    if out.is_file() and source.exists() and out.samefile(source):
        raise RecipeError(f"{out}: is what is read: give another path for the result")


def check_result(out: Path) -> None:
    """Raise `RecipeError` where no file can be written at a path, before the time for its contents is spent."""
    if out.is_dir():
        raise RecipeError(f"--out {out}: is a folder: give the name of a file in it, such as {out / 'solved.g2o'}")
    if not out.parent.is_dir():
        raise RecipeError(f"--out {out}: there is no folder {out.parent}: make it first")
