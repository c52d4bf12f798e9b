"""Checks of the paths of a command line."""

from __future__ import annotations

from pathlib import Path

from hodge_pipeline.errors import RecipeError


def keep_source(source: Path, out: Path) -> None:
    """Raise `RecipeError` where the result would be written over what is read, not every line of which may come back,
    or into its folder.
    """
    if not out.exists() or not source.exists():
        return
    if out.samefile(source):
        raise RecipeError(f"{out}: is what is read: give another path for the result")
    if out.is_dir() and out.resolve() in source.resolve().parents:
        raise RecipeError(f"{out}: holds what is read: give the name of a file or of a folder in it")


def check_result(out: Path) -> None:
    """Raise `RecipeError` where no file can be written at a path, before the time for its contents is spent."""
    if out.is_dir():
        raise RecipeError(f"--out {out}: is a folder: give the name of a file in it, such as {out / 'solved.g2o'}")
    if not out.parent.is_dir():
        raise RecipeError(f"--out {out}: there is no folder {out.parent}: make it first")
