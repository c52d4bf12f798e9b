"""What a run prints: one plain line for each stage where nobody looks, bars with rates in a terminal, or nothing."""

from __future__ import annotations

from types import SimpleNamespace
from typing import cast

import pytest
from rich.console import Console
from rich.progress import Task

from hodge_pipeline.cli import console
from hodge_pipeline.cli.console import ProgressBars, RateColumn
from hodge_pipeline.report.brief import at_most, labelled
from hodge_pipeline.types.notes import Note


def work(terminal: ProgressBars) -> None:
    with terminal:
        for title, total in (("recording", 1), ("clouds", 50), ("recording", 1)):
            with terminal.stage(title, total) as advance:
                advance(total)
        terminal.say("a [note]")


def test_plain_lines_without_a_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    work(ProgressBars(quiet=False, verbose=True))
    out, err = capsys.readouterr()
    lines = err.splitlines()
    assert out == ""
    assert lines[0].startswith("recording: done, ") and lines[0].endswith(" s")
    assert lines[1].startswith("clouds: done, 50 in ") and lines[1].endswith(" a second")
    assert lines[-1] == "a [note]"
    assert "\x1b" not in err


def test_what_nobody_waited_for_is_no_line_and_facts_wait_for_the_report(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = iter([0.0, 0.4, 1.0, 3.0, 4.0, 4.1])
    monkeypatch.setattr(console.time, "perf_counter", lambda: next(clock))
    terminal = ProgressBars(quiet=False)
    work(terminal)
    terminal.note(Note("solver", detail="a fact"))
    terminal.note(Note("parts", 2))
    lines = capsys.readouterr().err.splitlines()
    assert lines[:2] == ["clouds: done, 50 in 2.0 s, 25 a second", "a [note]"]
    assert len(lines) == 3 and "falls into 2 parts" in lines[2]


def test_recording_in_parts_is_one_line_at_the_end(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = iter([0.0, 1.5, 2.0, 4.0, 5.0, 7.0])
    monkeypatch.setattr(console.time, "perf_counter", lambda: next(clock))
    with ProgressBars() as terminal:
        work(terminal)
    lines = capsys.readouterr().err.splitlines()
    assert lines == ["clouds: done, 50 in 2.0 s, 25 a second", "a [note]", "recording: done, 3.5 s"]


def test_a_stage_that_fails_prints_no_line(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(ValueError), ProgressBars(quiet=False) as terminal, terminal.stage("clouds", 3):
        raise ValueError
    assert capsys.readouterr().err == ""


def test_a_bar_goes_on_where_what_was_done_is_done_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """Rich took it for finished: its rate stood still, and no time remained."""
    monkeypatch.setattr(console, "Console", lambda **options: Console(**{**options, "force_terminal": True}))
    with ProgressBars(quiet=False) as terminal, terminal.stage("sweeps", 10) as advance:
        advance(10)
        (task,) = terminal._progress.tasks
        assert task.finished
        advance(-8)
        assert not task.finished and task.completed == 2


def test_quiet_prints_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    work(ProgressBars(quiet=True))
    assert capsys.readouterr() == ("", "")


def test_bars_with_rates_in_a_terminal(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def terminal(**options: object) -> Console:
        return Console(**{**options, "force_terminal": True, "width": 120})

    monkeypatch.setattr(console, "Console", terminal)
    work(ProgressBars(quiet=False))
    shown = capsys.readouterr().err
    assert "50/50" in shown
    assert "2/2" in shown  # the two parts of the recording share a bar


@pytest.mark.parametrize(("speed", "total", "shown"), [(12.54, 50, "12.5/s"), (None, 50, ""), (3.0, 1, "")])
def test_the_rate_of_a_stage_of_many_units(speed: float | None, total: int, shown: str) -> None:
    task = SimpleNamespace(finished_speed=None, speed=speed, total=total)
    assert RateColumn().render(cast(Task, task)).plain == shown


def test_a_line_is_cut_after_a_clause_only_where_that_says_most_of_it() -> None:
    (early,) = at_most(labelled("look", "an edge that many others confirm: no loop of the backbone passes over it"), 1)
    assert early == "look     an edge that many others confirm: no loop of the backbone passes over …"
    (late,) = at_most(labelled("look", "the viewing graph falls into three parts that nothing connects: see there"), 1)
    assert late == "look     the viewing graph falls into three parts that nothing connects …"
