"""What a run logs, and the file that it goes to."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

log = logging.getLogger("hodge_pipeline")


@contextmanager
def logging_to(path: Path) -> Iterator[None]:
    """Add what the run logs to a file, each line with its time."""
    handler = logging.FileHandler(path, encoding="utf-8")
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(message)s"))
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
