"""Decisions about edges: stored as `hodge edit` stores them, with a log; a decision on an old state is refused."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

from hodge_pipeline.errors import GraphError, HodgeError, WorkspaceError, not_written
from hodge_pipeline.pairs.edits import VERBS, Edit, History, read_history, write_history
from hodge_pipeline.store.workspace import holding
from hodge_pipeline.types.input_files import read_input_text
from hodge_pipeline.types.text import cell, csv_text

COLUMNS = ("time", "who", "decision", "pairs", "verdict", "score", "residual_m", "residual_deg", "note")


class StaleError(HodgeError):
    """A decision came from a page that did not show the latest state."""


class LockedError(HodgeError):
    """No decision can be taken now."""


@dataclass(frozen=True)
class LogEntry:
    """Who decided, when (UTC, ISO 8601), why (`note`), and the facts of the worst edge at that time."""

    who: str = ""
    time: str = ""
    note: str = ""
    verdict: str = ""
    score: str = ""
    residual_m: str = ""
    residual_deg: str = ""


class Decisions:
    """The history of decisions in a file, with a revision that grows with each change, whoever makes it.

    Each change states the revision that its maker saw: an old one raises `StaleError`, and so does the first change
    after another program changed the file. What is written is on disk when a method returns.
    """

    def __init__(self, file: Path, log: Path, *, run_folder: Path | None, locked: str = "") -> None:
        self._file, self._log, self._run_folder, self._locked = file, log, run_folder, locked
        self.history = read_history(file)
        self.revision = 0
        self._undone: list[int] = []

    @property
    def can_redo(self) -> bool:
        """Whether this process undid an edit, and added none since."""
        return bool(self._undone)

    def why_locked(self) -> str:
        """Why no decision can be taken now; "" where one can."""
        try:
            with _held(self._run_folder):
                return self._locked
        except LockedError as error:
            return self._locked or str(error)

    def refresh(self) -> bool:
        """Read the file again, and tell whether another program has changed it."""
        found = read_history(self._file)
        if found == self.history:
            return False
        self.history, self._undone = found, []
        self.revision += 1
        return True

    def add(self, revision: int, edit: Edit, entry: LogEntry) -> None:
        """Add a decision. Raises `StaleError`, `LockedError`, `WorkspaceError`."""
        with self._changing(revision):
            self._put(self.history.added(edit), "", edit, entry)
            self._undone = []

    def undo(self, revision: int, entry: LogEntry) -> None:
        """Undo the latest decision that counts. Raises as `add`, and `GraphError` where there is none."""
        with self._changing(revision):
            row = self.history.latest
            undone = self.history.undo()
            assert row is not None
            self._put(undone, "undo ", self.history.edits[row], entry)
            self._undone.append(row)

    def redo(self, revision: int, entry: LogEntry) -> None:
        """Redo the decision that was undone last. Raises as `undo`."""
        with self._changing(revision):
            if not self._undone:
                raise GraphError("there is nothing to redo")
            again = self.history.redo(self._undone[-1])
            self._put(again, "redo ", again.edits[self._undone[-1]], entry)
            self._undone.pop()

    def lines(self) -> list[dict[str, str]]:
        """The log, oldest first."""
        if not self._log.exists():
            return []
        return list(csv.DictReader(io.StringIO(read_input_text(self._log), newline="")))

    @contextmanager
    def _changing(self, revision: int) -> Iterator[None]:
        """While the body runs no run uses the folder, and the history is that of this revision."""
        if self._locked:
            raise LockedError(self._locked)
        with _held(self._run_folder):
            if self.refresh():
                raise StaleError(
                    "the edits were changed by another program: what you see is now up to date, look again"
                )
            if revision != self.revision:
                raise StaleError(
                    f"this page shows revision {revision}, the edits are at {self.revision}: another page has decided "
                    "since; nothing was changed, look again"
                )
            yield

    def _put(self, history: History, prefix: str, edit: Edit, entry: LogEntry) -> None:
        try:
            write_history(self._file, history)
        except OSError as error:
            raise not_written(self._file, error) from error
        self.history = history
        self.revision += 1
        pairs = {verb: names for verb in VERBS if (names := getattr(edit, verb))}
        named = " ".join(name for names in pairs.values() for name in names)
        known = (entry.verdict, entry.score, entry.residual_m, entry.residual_deg)
        self._append([entry.time, entry.who, prefix + " ".join(pairs), named, *known, entry.note])

    def _append(self, cells: Sequence[str]) -> None:
        header = [] if self._log.exists() else [COLUMNS]
        text = csv_text([*header, [cell(word) for word in cells]])
        try:
            with self._log.open("a", encoding="utf-8", newline="") as file:
                file.write(text)
        except OSError as error:
            raise not_written(self._log, error) from error


@contextmanager
def _held(folder: Path | None) -> Iterator[None]:
    """While the body runs no run uses the folder, where there is one. Raises `LockedError` where one does."""
    with ExitStack() as stack:
        if folder is not None:
            try:
                stack.enter_context(holding(folder))
            except WorkspaceError as error:
                raise LockedError(f"{error}; until then this review can only be looked at") from error
        yield
