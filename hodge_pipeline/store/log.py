"""What a run logs, and the file that it goes to."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from hodge_pipeline.types.text import visible

log = logging.getLogger("hodge_pipeline")


class _OneLine(logging.Formatter):
    def format(self, record: logging.LogRecord) -> str:
        """The record on one line: a name with a line end in it would write a line of its own."""
        return visible(super().format(record))


class _File(logging.FileHandler):
    def handleError(self, record: logging.LogRecord) -> None:  # noqa: N802 - its name in `logging`
        """Ignore an error: a full disk stops the run where a result is written."""

    def close(self) -> None:
        """Close the file; on a full disk its last lines are lost."""
        with suppress(OSError):
            super().close()


@contextmanager
def logging_to(path: Path) -> Iterator[None]:
    """Add what the run logs to a file, each line with its time."""
    handler = _File(path, encoding="utf-8", errors="backslashreplace")
    handler.setFormatter(_OneLine("%(asctime)s %(levelname)s %(message)s"))
    log.addHandler(handler)
    log.setLevel(logging.INFO)
    log.propagate = False
    try:
        yield
    except BaseException as error:
        log.error("stopped: %s", error or type(error).__name__)
        raise
    finally:
        log.removeHandler(handler)
        handler.close()
