"""A report in ten lines of 80 columns, for a terminal."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator

from hodge_pipeline.report.contents import Report
from hodge_pipeline.report.suspicions import suspicions
from hodge_pipeline.report.verdict import judge
from hodge_pipeline.report.words import duration, next_commands, peak, worst_places
from hodge_pipeline.store.workspace import PAGE_FILE
from hodge_pipeline.types.notes import Rank
from hodge_pipeline.types.text import with_symbols

COLUMNS, LINES, LABEL = 80, 10, 9
FEWEST_POINTS, MOST_NOTES, MOST_OF_A_NOTE = 2, 2, 2
"""A terminal of 80 columns shows ten lines beside what was typed: the reasons, doubts and next commands share them."""


def brief(report: Report, folder: str) -> list[str]:
    """The verdict as a short list, where it is worst, what to heed, and what to type next; `folder` is the report's."""
    verdict = judge(report)
    head = labelled("verdict", verdict.headline)
    worrying = [str(note) for note in suspicions(report) if note.rank < Rank.FACT]
    tail = [line for place in list(worst_places(report))[:1] for line in labelled("worst", place)]
    for note in worrying[:MOST_NOTES]:
        tail += at_most(labelled("look", note), 1 if len(worrying) > 1 else MOST_OF_A_NOTE)
    tail += list(_end(report, folder))
    room = max(LINES - len(head) - len(tail), FEWEST_POINTS)
    points = verdict.points
    if len(points) > room:
        left = len(points) - room + 1
        points = (*points[: room - 1], f"… and {left} more measures: --verbose")
    return [*head, *(line for point in points for line in pointed(point)), *tail]


def all_notes(report: Report) -> list[str]:
    """Every note, whole."""
    return [line for note in suspicions(report) for line in labelled("note", str(note))]


def _end(report: Report, folder: str) -> Iterator[str]:
    if (total := report.total) is not None:
        stages = " in the stages" if len(report.stages) > 1 else ""
        yield from labelled("time", f"{duration(total.wall_s)}, {total.cpu_s:.1f} CPU s{stages}{peak(total)}")
    yield f"{'report':<{LABEL}}{folder}/{PAGE_FILE}"
    command = next(line for line in next_commands(report, folder) if not line.startswith("#"))
    yield f"{'next':<{LABEL}}{command}"


def labelled(label: str, text: str) -> list[str]:
    """The text beside its label, in as many lines as it takes; a path or a command is never broken."""
    lines = textwrap.wrap(with_symbols(text), COLUMNS - LABEL, break_long_words=False, break_on_hyphens=False) or [""]
    return [f"{label:<{LABEL}}{lines[0]}", *(f"{'':<{LABEL}}{line}" for line in lines[1:])]


def pointed(text: str) -> list[str]:
    """The text as a point of a list, in one line."""
    return at_most(textwrap.wrap(f"  - {with_symbols(text)}", COLUMNS), 1)


def at_most(lines: list[str], count: int) -> list[str]:
    """The first lines, the last of them ending in … where there are more: after a clause of ¾ of a line at least, or
    else after a word.
    """
    if len(lines) <= count:
        return lines
    cut = f"{lines[count - 1]} {lines[count].strip()}"[: COLUMNS - 1].rsplit(" ", 1)[0]
    clause = max(f"{cut} ".rfind(mark) for mark in (": ", "; ", ", "))
    return [*lines[: count - 1], f"{cut[:clause] if clause >= COLUMNS * 3 / 4 else cut} …"]
