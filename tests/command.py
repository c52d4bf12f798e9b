"""The command `hodge` as a user types it, but in this process: a start of Python with all libraries costs seconds."""

from __future__ import annotations

import io
import sys
from dataclasses import dataclass

import pytest

from hodge_pipeline.cli import entry


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
