"""Progress of a run: the pipeline reports to a watcher, such as the command line; by default to none."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from typing import Protocol

from hodge_pipeline.stages import Advance, no_progress
from hodge_pipeline.types.notes import Note

RECORDING = "recording"
"""The title of every step that only records: spread over the run, they are one stage to a watcher."""


class Watcher(Protocol):
    """Receives the begin, progress and end of each stage, and notes."""

    def stage(self, title: str, total: int) -> AbstractContextManager[Advance]:
        """A context whose value is called with the units just finished, of `total` in all; see `Advance`."""

    def note(self, note: Note) -> None:
        """A fact, as soon as it is known."""


class Nobody:
    """Watches nothing."""

    def stage(self, title: str, total: int) -> AbstractContextManager[Advance]:
        """A context that shows nothing."""
        return nullcontext(no_progress)

    def note(self, note: Note) -> None:
        """Nothing."""
