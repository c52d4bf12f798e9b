"""The terminal: progress bars while a run works, plain lines where none can be drawn, tables and JSON."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from importlib.util import find_spec
from typing import Any

from rich import box
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    Task,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.table import Column, Table
from rich.text import Text

from hodge_pipeline.cli.guard import unguarded
from hodge_pipeline.cli.options import Shown
from hodge_pipeline.stages import Advance, no_progress
from hodge_pipeline.store.artifacts import json_text
from hodge_pipeline.store.progress import RECORDING
from hodge_pipeline.types.notes import Note, Rank
from hodge_pipeline.types.text import visible, with_symbols

WAITED_FOR_S = 1.0
"""Seconds below which a stage gets no line."""


class ProgressBars:
    """A watcher that draws one bar for each stage, on stderr or in a notebook's cell; where neither can be drawn in, a
    plain line for each stage that took long enough to be waited for. `verbose`: for every stage, and every note.

    From Python: `with ProgressBars() as bars: hodge_pipeline.run(…, watcher=bars)`.
    """

    def __init__(self, quiet: bool = False, verbose: bool = False) -> None:
        self._verbose = verbose
        in_notebook = None if find_spec("ipywidgets") else False  # without it rich draws no bars there
        stream = unguarded(sys.stderr)
        self._console = Console(file=stream, quiet=quiet, highlight=False, soft_wrap=True, force_jupyter=in_notebook)
        self._tasks: dict[str, TaskID] = {}
        self._totals: dict[str, int] = {}
        self._recorded_s = 0.0
        self._draws = (self._console.is_terminal or self._console.is_jupyter) and not quiet
        self._progress = Progress(
            TextColumn("{task.description:<24}", table_column=Column(no_wrap=True, max_width=32)),
            BarColumn(),
            MofNCompleteColumn(),
            RateColumn(),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
            console=self._console,
            disable=not self._draws,
        )

    @classmethod
    def of(cls, shown: Shown) -> ProgressBars:
        """The bars of a command by its options: none where it prints JSON."""
        return cls(shown.quiet or shown.as_json, shown.verbose)

    def __enter__(self) -> ProgressBars:
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()
        if self._recorded_s >= WAITED_FOR_S:
            self._done(RECORDING, 1, self._recorded_s)
        self._recorded_s = 0.0

    def stage(self, title: str, total: int) -> AbstractContextManager[Advance]:
        """A bar of `total` units."""
        return self._bar(title, total) if self._draws else self._line(title, total)

    @contextmanager
    def _line(self, title: str, total: int) -> Iterator[Advance]:
        """One line when the stage is done, with amount and time; recording comes in parts, and gets its line last."""
        start = time.perf_counter()
        yield no_progress
        seconds = time.perf_counter() - start
        if title == RECORDING and not self._verbose:
            self._recorded_s += seconds
        elif seconds >= WAITED_FOR_S or self._verbose:
            self._done(title, total, seconds)

    def _done(self, title: str, total: int, seconds: float) -> None:
        amount = f"{total} in {seconds:.1f} s, {total / seconds:.3g} a second" if total > 1 else f"{seconds:.1f} s"
        self.say(f"{title}: done, {amount}")

    @contextmanager
    def _bar(self, title: str, total: int) -> Iterator[Advance]:
        """Stages of one title, such as the recording's parts, share a bar."""
        task = self._tasks.get(title)
        if task is None:
            task = self._tasks[title] = self._progress.add_task(title, total=0)
        before = self._totals[title] = self._totals.get(title, 0)
        self._totals[title] += total
        self._progress.update(task, total=self._totals[title])

        def advance(done: int) -> None:
            self._progress.advance(task, done)
            if done < 0:  # rich takes what was once complete for finished
                own = next(one for one in self._progress.tasks if one.id == task)
                own.finished_time = own.finished_speed = None

        yield advance
        self._progress.update(task, completed=before + total)

    def note(self, note: Note) -> None:
        """Print the note's sentence, of a mere fact only where `verbose`."""
        if self._verbose or note.rank < Rank.FACT:
            self.say(str(note))

    def say(self, message: str) -> None:
        """One line above the bars."""
        self._console.print(visible(with_symbols(message)), markup=False)


class RateColumn(ProgressColumn):
    """Units a second; nothing of a stage with a single unit."""

    def render(self, task: Task) -> Text:
        """The rate while it runs, of the whole once it is done."""
        rate = task.finished_speed or task.speed
        return Text(f"{rate:.3g}/s" if rate and (task.total or 0) > 1 else "", style="progress.data.speed")


def print_json(data: Any) -> None:
    """A value on stdout as JSON, a line for each number or word."""
    print(json_text(data), end="")


def print_table(title: str, header: Sequence[str], rows: Sequence[Sequence[str]], *, words: Sequence[str] = ()) -> None:
    """A table on stdout, numbers to the right; `words` are columns of text, as the first is."""
    table = Table(title=Text(visible(title)), title_justify="left", box=box.SIMPLE_HEAD)
    for row, name in enumerate(header):
        table.add_column(name, justify="left" if row == 0 or name in words else "right", overflow="fold")
    for cells in rows:
        table.add_row(*(Text(visible(with_symbols(cell))) for cell in cells))
    Console(highlight=False, file=unguarded(sys.stdout)).print(table)
