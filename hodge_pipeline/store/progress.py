"""Who watches a run: the pipeline tells, the command line shows. Nobody watching is the default."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from typing import Protocol

from hodge_pipeline.stages import Advance, no_progress
from hodge_pipeline.types.notes import Note

RECORDING = "recording"
"""The title of every step that only records: they are spread over the run, and make one stage for who watches."""


class Watcher(Protocol):
    """Is told of each stage as it begins, moves and ends."""

    def stage(self, title: str, total: int) -> AbstractContextManager[Advance]:
        """A context whose value is called with the units just finished, of `total` in all."""

    def note(self, note: Note) -> None:
        """A fact, as soon as it is known."""


class Nobody:
    """Watches nothing."""

    def stage(self, title: str, total: int) -> AbstractContextManager[Advance]:
        """A context that shows nothing."""
        return nullcontext(no_progress)

    def note(self, note: Note) -> None:
        """Nothing."""
