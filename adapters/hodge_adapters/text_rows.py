"""Rows of numbers and names in text files, with their line numbers, so that a complaint can name the line."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import IO

from hodge_pipeline.errors import SourceError, not_read, not_written
from hodge_pipeline.types.input_files import beginning, read_input_text
from hodge_pipeline.types.output_files import replacing

_DIGITS = re.compile(r"(\d+)")
_DECIMAL = r"[-+]?\d+(,\d+)?([eE][-+]?\d+)?"
DECIMAL_ROW = re.compile(rf"\s*{_DECIMAL}(\s+{_DECIMAL}){{2,}}\s*")
"""Numbers between blanks that have a comma each at most, such as `1,5 -2,25e-1 3`: as decimal point."""
SNIFFED_BYTES = 4096
MAX_NAME_BYTES, MAX_PATH = 255, 2000
"""Bytes of a name in a folder, characters of a path below one: the system refuses longer ones."""
SHOWN = 5
"""How many records a note names before it only counts them."""


@dataclass(frozen=True)
class Row:
    """The fields of one line, and its number from 1."""

    line: int
    fields: list[str]


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """While a file is read: what the system refuses becomes a `SourceError` that names it."""
    try:
        yield
    except OSError as error:
        raise not_read(path, error) from error


def names_in(folder: Path) -> list[str]:
    """The names in a folder, ascending; raises `SourceError` where it cannot be listed."""
    try:
        return sorted(os.listdir(folder))
    except OSError as error:
        raise SourceError(f"{folder}: cannot be listed ({error.strerror}): give a folder that can be read") from error


def first_text(path: Path, size: int = SNIFFED_BYTES) -> str:
    """The first characters of a file, empty where it cannot be read."""
    return beginning(path, size).decode("utf-8-sig", "replace")


def read_text(path: Path) -> str:
    """The text of a file, whatever its bytes; raises `SourceError` where it cannot be read."""
    with reading(path):
        return read_input_text(path, errors="replace")


def read_rows(path: Path) -> list[Row]:
    """The rows of a file; see `rows_of`."""
    return rows_of(read_text(path))


def rows_of(text: str) -> list[Row]:
    """The lines that hold anything but a `#` comment, cut at blanks, tabs and commas, or semicolons without a comma."""
    lines = (line.split("#", 1)[0] for line in text.splitlines())
    cut = (Row(number, line.replace(separator_of(line), " ").split()) for number, line in enumerate(lines, 1))
    return [row for row in cut if row.fields]


def separator_of(line: str) -> str:
    """What separates the fields of a line beside blanks: a semicolon only where there is no comma, which may be a
    decimal point, as in `1,5;2,5`: such a line is not to look right.
    """
    return "," if "," in line else ";"


def to_floats(fields: Sequence[str]) -> list[float] | None:
    """The numbers, or None where a field is not one."""
    try:
        return [float(field) for field in fields]
    except ValueError:
        return None


def listed(items: Sequence[object]) -> str:
    """The first few items by name, and how many more there are."""
    more = f" and {len(items) - SHOWN} more" if len(items) > SHOWN else ""
    return ", ".join(str(item) for item in items[:SHOWN]) + more


def natural(name: str) -> tuple[tuple[int, int, str], ...]:
    """A sort key that takes digits for numbers."""
    parts = (part for part in _DIGITS.split(name) if part)
    return tuple((0, int(part[:18]), part) if part.isascii() and part.isdecimal() else (1, 0, part) for part in parts)


def inside(folder: Path, name: str) -> Path | None:
    """The path of a file named in a list, or None for one that leaves the folder by `..` or an absolute path out of it,
    or has a longer name than file systems allow.

    Links inside the folder are the user's own and are followed.
    """
    pure = PurePosixPath(name.replace("\\", "/"))
    too_long = len(name) > MAX_PATH or any(len(part.encode("utf-8", "replace")) > MAX_NAME_BYTES for part in pure.parts)
    leaves = pure.is_absolute() and not pure.is_relative_to(folder.absolute())
    return None if leaves or ".." in pure.parts or too_long else folder / pure


def write_text_atomically(path: Path, text: str) -> None:
    """Write ASCII text in one step; see `write_bytes_atomically`."""
    write_bytes_atomically(path, text.encode("ascii"))


def write_bytes_atomically(path: Path, contents: bytes) -> None:
    """Write the file in one step: a reader sees the old one or the whole new one. Raises `WorkspaceError`."""
    with opened_atomically(path) as file:
        file.write(contents)


@contextmanager
def opened_atomically(path: Path) -> Iterator[IO[bytes]]:
    """A file to be written, which takes its name once the body ends well. Raises `WorkspaceError`."""
    try:
        with replacing(path) as file:
            yield file
    except OSError as error:
        raise not_written(path, error) from error
