"""Write output files atomically: a reader sees the old file or all of the new one."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO

DEVICES = Path("/dev")


def draft_of(path: Path) -> Path:
    """The name of a file while this process writes it; a killed process leaves it behind."""
    return path.with_name(f".{path.name}.{os.getpid()}.draft")


@contextmanager
def replacing(path: Path) -> Iterator[IO[bytes]]:
    """A file to write, which replaces `path` once the body ends well and all is on the disk. Raises `OSError`, also
    where `path` is a device or a pipe: the user root would replace `/dev/null` itself for every program.
    """
    is_special = path.exists() and not path.is_file() and not path.is_dir()
    if is_special or path.parent.resolve() == DEVICES:  # /dev/stdout may be a link to a file
        raise OSError(errno.EINVAL, "a device or pipe", str(path))
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
