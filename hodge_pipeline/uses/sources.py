"""Open a source from Python: any path that a reader knows."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from hodge_pipeline import registry
from hodge_pipeline.recipe.binding import stage_of
from hodge_pipeline.sources import opening
from hodge_pipeline.sources.inspect import guess_reader
from hodge_pipeline.stages import FrameReader
from hodge_pipeline.types import Source


def open_source(path: Path | str, reader: str | FrameReader | None = None, **options: Any) -> Source:
    """The source at a path: lazy frames, a trajectory, a measured graph, as far as its format holds them.

    `reader` is the name of a format (`hodge stages readers`), with `options` such as `every=10`, or a reader itself; by
    default the reader that is surest of the path. Raises `SourceError`, and `RecipeError` for an unknown
    reader or option.
    """
    path = Path(path)
    if reader is None and options:
        reader = registry.name_of(guess_reader(path))
    chosen = None if reader is None else stage_of("readers", reader, options, "open_source")
    return opening.open_with_reader(path, chosen)[0]
