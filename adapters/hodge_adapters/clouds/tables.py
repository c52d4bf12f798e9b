"""Points in text tables (XYZ, ASC, CSV), one a line, with or without a line of names."""

from __future__ import annotations

import re
from codecs import BOM_UTF8
from collections.abc import Iterator, Sequence
from itertools import islice
from pathlib import Path

from hodge_adapters.clouds.columns import NAMES, OTHER_NAMES, Columns, is_time, number_rows
from hodge_adapters.text_rows import DECIMAL_ROW, first_text, reading, to_floats
from hodge_pipeline.errors import SourceError
from hodge_pipeline.types import Floats
from hodge_pipeline.types.input_files import open_input

SEPARATORS, DECIMAL_COMMAS = bytes.maketrans(b",;", b"  "), bytes.maketrans(b",;", b". ")
"""Between numbers, where a comma is one; where there are semicolons, it is none."""
COMMENTS = (b"#", b"//")


def names_points(path: Path) -> bool:
    """Whether the first line of a table begins x, y, z: in those of poses or accelerations other columns come first."""
    return fields_of(first_text(path))[:3] == ["x", "y", "z"]


def table_parts(path: Path) -> Iterator[Columns]:
    """The points of a table as columns, in parts: by the names above its rows, as CloudCompare's `//X Y Z R G B`,
    without names its first three numbers. Comments and a line with the count of the rows may stand above them.

    Raises `SourceError` where rows differ in length, are no numbers or others than counted, or a column comes twice.
    """
    names: list[str] = []
    row, skipped, said = "", 0, None
    for line in first_text(path).splitlines():
        fields, is_comment = fields_of(line), not is_row(line.encode())
        if fields and to_floats(fields[:1]) is None and not names and (not is_comment or {*"xyz"} <= {*fields}):
            names, skipped = [OTHER_NAMES.get(name, name) for name in fields], skipped + (not is_comment)
        elif not is_comment and len(fields) == 1 and fields[0].isdecimal() and said is None:
            said, skipped = int(fields[0][:18]), skipped + 1
        elif not is_comment:
            row = line
            break
    separators = DECIMAL_COMMAS if ";" in row or DECIMAL_ROW.fullmatch(row) else SEPARATORS
    width = len(names) or len(row.encode().translate(separators).split())
    if width < 3:
        raise SourceError(f"{path}: its first line holds no x, y and z: give a file of points")
    if twice := next((name for name in names if (name in NAMES or is_time(name)) and names.count(name) > 1), None):
        raise SourceError(f"{path}: its first line names {twice} twice: rename one of the columns")
    names = names or [*"xyz", *(f"_{at}" for at in range(3, width))]
    return row_parts(path, names, skipped, separators, said)


def row_parts(
    path: Path, names: Sequence[str], skipped: int, separators: bytes = SEPARATORS, said: int | None = None
) -> Iterator[Columns]:
    """The columns, in parts, of a text file whose rows (`is_row`), after those `skipped`, are of so many numbers.

    Raises `SourceError` where they are not, or are others than `said`.
    """
    with reading(path), open_input(path) as file:
        count = sum(map(is_row, file)) - skipped
        if said not in (None, count):
            raise SourceError(f"{path}: says {said} points, has {count}: copy it again")
        file.seek(0)
        lines = (line.removeprefix(BOM_UTF8).translate(separators) for line in file if is_row(line))
        tables: Iterator[Floats] = number_rows(path, islice(lines, skipped, None), count, len(names))
        yield from (dict(zip(names, table.T, strict=True)) for table in tables)


def is_row(line: bytes) -> bool:
    """Whether a line is neither blank nor a comment."""
    text = line.removeprefix(BOM_UTF8).lstrip()
    return bool(text) and not text.startswith(COMMENTS)


def fields_of(text: str) -> list[str]:
    """What stands on the first line that is not blank, in small letters."""
    first = next(iter(text.lstrip().splitlines()), "")
    return [field for field in re.split(r"[\s,;/#\"]+", first.lower()) if field]
