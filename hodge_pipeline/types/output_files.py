"""The one way to write an output file: a reader sees the old one or all of the new one."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO


def draft_of(path: Path) -> Path:
    """What a file is called while this process writes it; a killed one leaves it there."""
    return path.with_name(f".{path.name}.{os.getpid()}.draft")


@contextmanager
def replacing(path: Path) -> Iterator[IO[bytes]]:
    """A file to be written, which takes its name, all of it on the disk, once the body ends well. Raises `OSError`."""
    draft = draft_of(path)
    try:
        with open(draft, "wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(draft, path)
    except BaseException:
        with suppress(OSError):
            draft.unlink()
        raise
