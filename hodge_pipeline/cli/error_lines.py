"""How a command that fails ends: what a user can mend is one line on stderr and an exit code."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NoReturn

from hodge_pipeline.cli.guard import shown_error


@contextmanager
def one_line_errors() -> Iterator[None]:
    """End the program with code 1 for what a user can mend, 3 for a result that failed its checks; raise the rest."""
    try:
        yield
    except OSError as error:
        if error.filename is None and error.errno is None:
            raise
        _end(f"{shown_error(error.filename or 'a file')}: {error.strerror}")
    except MemoryError:
        _end("this needs more memory than there is: give less data, or free some")
    except ImportError as error:
        if (error.name or "").startswith("hodge"):
            raise
        from hodge_pipeline.registry import LIBRARIES, give_way_to_ctrl_c

        give_way_to_ctrl_c(error)
        _end(f"a library does not load ({shown_error(error)}): {LIBRARIES}")
    except Exception as error:
        from hodge_pipeline.errors import HodgeError
        from hodge_pipeline.registry import plugin_error

        known = plugin_error(error) or error
        if not isinstance(known, HodgeError):
            raise
        _end(shown_error(known), known.exit_code)


def _end(line: str, code: int = 1) -> NoReturn:
    print(f"error: {line}", file=sys.stderr)
    sys.exit(code)
