"""Names that strangers wrote reach terminal, log, shell commands, tables and file names without effect there."""

from __future__ import annotations

import csv
import io
import logging
import shlex
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hodge_pipeline.cli.console import ProgressBars, print_table
from hodge_pipeline.cli.guard import guard_streams, shown_error
from hodge_pipeline.report.run_files import write_poses
from hodge_pipeline.store.edge_table import read_edges, write_edges
from hodge_pipeline.store.log import log, logging_to
from hodge_pipeline.types import Edges, Frame, Source
from hodge_pipeline.types.edges import USED
from hodge_pipeline.types.text import cell, cell_text, command, file_stems, visible

HOSTILE = [
    "\x1b[31mred", "a\nb", "a\rb", "\x9b2J", "\x07", "\u202eevil", "\u2028line", "\udcff", "\x7f", "\x00",
    "\x1b]8;;http://x\x07link", "\u200bhidden", "=HYPERLINK(\"http://x\")", "+1+1", "-1+1", "@SUM(1)", "\t=1",
    "'=1", "''", "[bold red]x[/]", "{count}", "<script>alert(1)</script>", "$(touch x)", "`x`; rm -r", "../../x", "a/b",
    "a_b", "A_b", "", ".", "..", "x" * 300, "name with spaces", "ж" * 90, "-rf",
]  # fmt: skip


def sent(text: str) -> bool:
    """Whether a character of the text has an effect of its own."""
    return any(not c.isprintable() and c not in "\n\t" for c in text)


@pytest.mark.parametrize("name", HOSTILE)
def test_text_is_visible_on_one_line(name: str) -> None:
    assert not sent(visible(name))
    assert "\n" not in visible(name)
    assert visible("a wall, 5 µm – ω") == "a wall, 5 µm – ω"


@pytest.mark.parametrize("name", HOSTILE)
def test_nothing_reaches_the_terminal_or_the_log(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "stdout", sys.stdout)
    monkeypatch.setattr(sys, "stderr", sys.stderr)
    guard_streams()
    print(f"note {name}")
    ProgressBars(quiet=False).say(f"note {name}")
    print_table(name, ("a", "b"), [(name, name)])
    with logging_to(tmp_path / "log.txt"):
        log.warning("note %s", name)
    logging.getLogger("hodge_pipeline").propagate = True
    printed = capsys.readouterr()
    logged = (tmp_path / "log.txt").read_text("utf-8")
    assert not sent(printed.out + printed.err + logged)
    assert "note" in printed.out
    assert "note" in printed.err
    assert logged.count("\n") == 1
    if "[bold" in name:
        assert "[bold" in printed.err


@pytest.mark.parametrize("name", [name for name in HOSTILE if "\0" not in name and "\udcff" not in name])
def test_a_printed_command_is_what_it_says(name: str, tmp_path: Path) -> None:
    words = ["printf", "%s", name]
    assert shlex.split(command(*words)) == words
    done = subprocess.run(command(*words), shell=True, capture_output=True, cwd=tmp_path, check=True)
    assert done.stdout == name.encode()
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", HOSTILE)
def test_no_cell_is_a_formula_and_each_reads_back(name: str) -> None:
    assert cell(name)[:1] not in ("=", "+", "-", "@", "\t", "\r")
    assert cell_text(cell(name)) == name


def test_a_table_of_hostile_names_reads_back(tmp_path: Path) -> None:
    names = np.array([name for name in HOSTILE if name.rstrip("\0") == name and "\udcff" not in name])
    rows = np.arange(len(names) - 1)
    edges = replace(Edges.of(np.column_stack([rows, rows + 1])), status=np.full(len(rows), USED), why=names[:-1])
    write_edges(tmp_path / "edges.csv", edges, names)
    for row in csv.reader(io.StringIO((tmp_path / "edges.csv").read_text("utf-8"))):
        assert all(text[:1] not in ("=", "+", "-", "@", "\t", "\r") for text in row[:2])
    back, found = read_edges(tmp_path / "edges.csv")
    ends = found[back.pairs].tolist()
    assert ends == names[edges.pairs].tolist()


def test_each_sequence_has_a_file_in_the_folder(tmp_path: Path) -> None:
    stems = file_stems(HOSTILE)
    assert len({stem.casefold() for stem in stems}) == len(HOSTILE)
    assert not any("/" in stem or "\0" in stem or len(stem.encode()) > 240 for stem in stems)
    names = [name for name in HOSTILE if not name.endswith("\0")]
    frames = [Frame(row, float(row), sequence=name) for row, name in enumerate(names)]
    out = tmp_path / "out"
    out.mkdir()
    write_poses(out, Source("x", tmp_path, frames), np.tile(np.eye(4), (len(frames), 1, 1)))
    assert [entry.name for entry in tmp_path.iterdir()] == ["out"]
    assert len(list(out.glob("poses-*.tum"))) == len(set(names))


def test_an_error_that_quotes_at_length_keeps_its_beginning_and_its_end() -> None:
    text = "list.txt: " + "a" * 10_000_000 + ": give another name\x07"
    found = shown_error(ValueError(text))
    assert found.startswith("list.txt: aaa") and found.endswith("aaa: give another name\\x07") and len(found) < 1100
    assert shown_error("short") == "short"
