"""Stand-ins for tests: a watcher that keeps what it is told, and steps that keep what they are asked for."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from hodge_pipeline.types.notes import Note


class Log:
    """A watcher that remembers which stages really ran, and may stop the run at one."""

    def __init__(self, stop_at: str = "") -> None:
        self.stop_at, self.stages, self.said = stop_at, list[str](), list[str]()

    @contextmanager
    def stage(self, title: str, total: int) -> Iterator[object]:
        self.stages.append(title)
        if title == self.stop_at:
            raise KeyboardInterrupt
        yield lambda done: None

    def note(self, note: Note) -> None:
        self.said.append(str(note))


class Told:
    """Steps that compute nothing: they keep what they are asked for, and answer the same to all."""

    def __init__(self, answer: object) -> None:
        self.answer, self.asked = answer, list[tuple[Any, ...]]()

    def step(self, *function_and_inputs: Any, **_: Any) -> Any:
        self.asked.append(function_and_inputs)
        return self.answer

    def note(self, *notes: Note) -> None:
        pass

    def key(self, value: object) -> str:
        return "key"

    def remember(self, value: object, key: str) -> None:
        pass
