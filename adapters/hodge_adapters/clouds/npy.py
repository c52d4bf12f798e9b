"""Points in NumPy's `.npy` files: rows of x, y, z and whatever follows, or records with these names."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hodge_adapters.clouds.columns import ROWS_IN_PART, Columns
from hodge_adapters.text_rows import reading
from hodge_pipeline.errors import SourceError

MOST_COLUMNS = 6
"""x, y, z, a reflectance, a beam and a time; poses have seven, eight or twelve, images more."""


def holds_points(path: Path) -> bool:
    """Whether the header tells a table of points; true where it cannot be read: that is said where the points are."""
    with suppress(SourceError):
        return _is_table(_table(path))
    return path.is_file()


def npy_parts(path: Path) -> Iterator[Columns]:
    """The points as columns, in parts; of a table without names the first three. Raises `SourceError` for others."""
    table = _table(path)
    if not _is_table(table):
        raise SourceError(f"{path}: holds an array {table.shape} of {table.dtype}: give rows of x y z")
    for start in range(0, max(1, len(table)), ROWS_IN_PART):
        part = np.array(table[start : start + ROWS_IN_PART])
        yield (
            {name: part[name] for name in part.dtype.names}
            if part.dtype.names
            else dict(zip("xyz", part.T, strict=False))
        )


def _is_table(table: NDArray[Any]) -> bool:
    if table.dtype.names:
        return table.ndim == 1 and {*"xyz"} <= {*table.dtype.names}
    return table.ndim == 2 and table.dtype.kind == "f" and 3 <= table.shape[1] <= MOST_COLUMNS


def _table(path: Path) -> NDArray[Any]:
    """The array of a file, not yet in memory; objects, which run code where they are read, are refused."""
    if not path.is_file():  # a pipe would be waited for
        raise SourceError(f"{path}: no file: give a file of points")
    try:
        with reading(path):
            return np.asarray(np.lib.format.open_memmap(path, mode="r"))
    except SourceError:
        raise
    except Exception as error:  # the header is Python: numpy raises whatever its tokenizer and its types do
        words = " ".join(str(error).split())[:200]
        raise SourceError(f"{path}: no .npy file of numbers ({words}): save it again") from error
