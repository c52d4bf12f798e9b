"""Points in text tables (XYZ, ASC, CSV), one a line, with or without a line of names."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from itertools import islice
from pathlib import Path

from hodge_adapters.clouds.columns import Columns, number_rows
from hodge_adapters.clouds.ply import COLOURS
from hodge_adapters.text_rows import first_text, reading, to_floats
from hodge_pipeline.errors import SourceError
from hodge_pipeline.types import Floats
from hodge_pipeline.types.input_files import open_input

SEPARATORS = bytes.maketrans(b",;", b"  ")


def names_points(path: Path) -> bool:
    """Whether the first line of a table begins x, y, z: in those of poses or accelerations other columns come first."""
    return fields_of(first_text(path))[:3] == ["x", "y", "z"]


def table_parts(path: Path) -> Iterator[Columns]:
    """The points of a table as columns, in parts, by the names on its first line, as CloudCompare's `//X Y Z R G B`;
    without names its first three numbers. Raises `SourceError` where rows differ in length or are no numbers.
    """
    fields = fields_of(first_text(path))
    named = to_floats(fields) is None
    if len(fields) < 3:
        raise SourceError(f"{path}: its first line holds no x, y and z: give a file of points")
    names = [COLOURS.get(name, name) for name in fields] if named else [*"xyz", *(f"_{at}" for at in fields[3:])]
    return row_parts(path, names, int(named))


def row_parts(path: Path, names: Sequence[str], skipped: int) -> Iterator[Columns]:
    """The columns, in parts, of a text file whose lines, after those `skipped`, are rows of so many numbers; blank
    lines are none.

    Raises `SourceError` where they are not.
    """
    with reading(path), open_input(path) as file:
        count = sum(1 for line in file if line.strip()) - skipped
        file.seek(0)
        lines = (line.translate(SEPARATORS) for line in file if line.strip())
        tables: Iterator[Floats] = number_rows(path, islice(lines, skipped, None), count, len(names))
        yield from (dict(zip(names, table.T, strict=True)) for table in tables)


def fields_of(text: str) -> list[str]:
    """What stands on the first line that is not blank, in small letters."""
    first = next(iter(text.lstrip().splitlines()), "")
    return [field for field in re.split(r"[\s,;/#\"]+", first.lower()) if field]
