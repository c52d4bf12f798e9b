"""SQLite files that are not trusted: read-only, plain tables alone, with limits on values and work."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from urllib.parse import quote

from hodge_pipeline.types.input_files import open_input

MAGIC = b"SQLite format 3\0"
DAMAGED = (sqlite3.Error, OSError, OverflowError, TypeError, ValueError)
"""What a file that is no database, or one whose cells hold values of another type, ends in."""
ALWAYS_STEPS, STEPS_A_BYTE, STEPS_AT_ONCE = 10_000_000, 10, 10_000
"""Steps of SQLite's virtual machine: reading a row takes 20, and a row some 100 bytes of the file."""


@contextmanager
def opened_database(path: Path, tables: Sequence[str], max_value_bytes: int) -> Iterator[sqlite3.Connection]:
    """The database, read-only: `immutable` needs no write access, not even for a journal beside the file.

    What is read must be `tables`: a view, or a table that a module makes up, computes what its author likes. No value
    is larger, and no query works longer, than the file's size has use for.
    """
    open_input(path).close()
    with closing(sqlite3.connect(f"file:{quote(str(path.resolve()))}?mode=ro&immutable=1", uri=True)) as database:
        database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, max_value_bytes)
        steps = iter(range(1 + (ALWAYS_STEPS + STEPS_A_BYTE * path.stat().st_size) // STEPS_AT_ONCE))
        database.set_progress_handler(lambda: next(steps, None) is None, STEPS_AT_ONCE)
        for table in tables:
            found = database.execute("SELECT type, rootpage FROM sqlite_master WHERE name = ? COLLATE NOCASE", (table,))
            if any(kind != "table" or not page for kind, page in found):
                raise sqlite3.DatabaseError(f"{table} is no plain table")
        yield database
