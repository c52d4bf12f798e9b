"""The command `hodge` as a user types it, but in this process: a start of Python with all libraries costs seconds."""

from __future__ import annotations

import csv
import io
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest
from typer.testing import CliRunner

from hodge_pipeline.cli import entry
from hodge_pipeline.cli.main import app


@dataclass(frozen=True)
class Ended:
    """What the command left."""

    returncode: int
    stdout: str
    stderr: str


def hodge(*words: object) -> Ended:
    """Run the command with these words; what it does not expect is raised here."""
    out, told, code = io.StringIO(), io.StringIO(), 0
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["hodge", *map(str, words)])
        patch.setattr(sys, "stdout", out)
        patch.setattr(sys, "stderr", told)
        try:
            entry.main()
        except SystemExit as ended:
            code = int(ended.code or 0)
    return Ended(code, out.getvalue(), told.getvalue())


def told(*words: object) -> str:
    """What the command with these words prints, which must succeed; whatever stops it is raised here."""
    done = CliRunner().invoke(app, [*map(str, words)], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    return done.stdout


def rows_of(folder: Path) -> list[dict[str, str]]:
    """The table of edges in a folder of results."""
    with (folder / "edges.csv").open() as file:
        return list(csv.DictReader(file))
