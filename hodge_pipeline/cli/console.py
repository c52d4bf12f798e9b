"""What a run looks like in the terminal: bars while it works, plain and quiet where nobody looks."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.table import Table

from hodge_pipeline.stages import Advance


class Terminal:
    """A watcher that draws one bar for each stage on stderr, or nothing at all where that is not a terminal."""

    def __init__(self, quiet: bool) -> None:
        self._console = Console(stderr=True, quiet=quiet, highlight=False)
        self._tasks: dict[str, TaskID] = {}
        self._totals: dict[str, int] = {}
        self._progress = Progress(
            TextColumn("{task.description:<24}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
            console=self._console,
            disable=quiet or not self._console.is_terminal,
        )

    def __enter__(self) -> Terminal:
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()

    def stage(self, title: str, total: int) -> AbstractContextManager[Advance]:
        """A bar of `total` units."""
        return self._bar(title, total)

    @contextmanager
    def _bar(self, title: str, total: int) -> Iterator[Advance]:
        """Stages of one title, such as the recording's parts, share a bar."""
        task = self._tasks.get(title)
        if task is None:
            task = self._tasks[title] = self._progress.add_task(title, total=0)
        before = self._totals[title] = self._totals.get(title, 0)
        self._totals[title] += total
        self._progress.update(task, total=self._totals[title])
        yield lambda done: self._progress.advance(task, done)
        self._progress.update(task, completed=before + total)

    def say(self, message: str) -> None:
        """One line above the bars."""
        self._console.print(message, markup=False)


def print_table(title: str, header: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """A table on stdout, numbers to the right."""
    table = Table(title=title, title_justify="left")
    for row, name in enumerate(header):
        table.add_column(name, justify="left" if row == 0 else "right")
    for cells in rows:
        table.add_row(*cells)
    Console(highlight=False).print(table)
