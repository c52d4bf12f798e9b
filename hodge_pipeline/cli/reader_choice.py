"""The reader that `--reader NAME --set OPTION=VALUE` means, for the commands that only open a path."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from hodge_pipeline import registry
from hodge_pipeline.errors import RecipeError
from hodge_pipeline.recipe import binding
from hodge_pipeline.sources.inspect import guess_reader
from hodge_pipeline.stages import FrameReader
from hodge_pipeline.store import yaml_file

IN_A_RECIPE = "source.reader."
"""What comes before an option of the reader in a recipe, and in what readers advise."""


def choose_reader(path: Path, name: str | None, settings: Sequence[str]) -> FrameReader:
    """The reader of this name, else the surest of the path, with these options.

    Raises `RecipeError` that names the setting, `SourceError` where no reader knows the path.
    """
    if name is None and not settings:
        return guess_reader(path)
    cls = registry.load("readers", name) if name else type(guess_reader(path))
    options: dict[str, object] = {}
    for setting in settings:
        key, equals, text = setting.partition("=")
        key = key.strip().removeprefix(IN_A_RECIPE)
        if not equals or not key:
            raise RecipeError(f"--set {setting}: expected OPTION=VALUE, an option of the reader")
        options[key] = yaml_file.parse_value(text, f"--set {setting}").data["value"]
    reader: FrameReader = binding.bind(cls, options, lambda keys: "--set")
    return reader
