"""What was left out of a recording and why, counted, so that a million bad messages make one line."""

from __future__ import annotations

from collections import Counter

MAX_KINDS = 30
"""How many kinds of fault have a line of their own: damage can make up as many as there are messages."""


class Complaints:
    """Collects faults while a recording is read; `notes` gives one line for each kind."""

    def __init__(self) -> None:
        self._counts: Counter[tuple[str, str]] = Counter()
        self._lines: list[str] = []
        self._others = 0

    def count(self, where: str, what: str) -> None:
        """Count one fault `what` ("a message that …") of a topic or file."""
        if (where, what) in self._counts or len(self._counts) < MAX_KINDS:
            self._counts[where, what] += 1
        else:
            self._others += 1

    def say(self, line: str) -> None:
        """Report something once."""
        if line in self._lines:
            return
        if len(self._lines) < MAX_KINDS:
            self._lines.append(line)
        else:
            self._others += 1

    def counted(self, fault: str | None = None) -> list[str]:
        """The counts in the order of their first fault, those of one `fault` alone where it is given."""
        kinds = [(kind, count) for kind, count in self._counts.items() if fault in (None, kind[1])]
        return [f"{where}: {count} left out: {what}" for (where, what), count in kinds]

    def notes(self) -> list[str]:
        """All that was said, then the counts."""
        others = [f"{self._others} other faults of many kinds"] if self._others else []
        return [*self._lines, *self.counted(), *others]
