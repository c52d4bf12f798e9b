"""Points of VTK's legacy files (https://docs.vtk.org, "VTK File Formats"): ascii, and binary, which is big-endian."""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from hodge_adapters.clouds.columns import Columns, parts_of
from hodge_adapters.text_rows import reading
from hodge_pipeline.errors import SourceError
from hodge_pipeline.types import Floats
from hodge_pipeline.types.input_files import read_input

_HEADER = re.compile(rb"# vtk DataFile[^\n]*\n[^\n]*\n\s*(ASCII|BINARY)\s", re.IGNORECASE)
_POINTS = re.compile(rb"\n[ \t]*POINTS[ \t]+(\d{1,15})[ \t]+(float|double)[ \t]*\r?\n", re.IGNORECASE)
_CODES = {b"float": ">f4", b"double": ">f8"}
LEAST_DIGITS = 2
"""Bytes of a number in text, with the blank before the next."""


def vtk_parts(path: Path) -> Iterator[Columns]:
    """The `POINTS` of a file as columns, in parts, of whatever dataset (PolyData as a rule); what it says of them is
    left.

    Raises `SourceError` for another format, for sizes that its bytes cannot hold, for text that is no numbers.
    """
    with reading(path):
        contents = read_input(path)
    header = _HEADER.match(contents)
    found = _POINTS.search(contents, header.end() - 1) if header else None
    if header is None or found is None:
        raise SourceError(f"{path}: no legacy VTK file with POINTS of float or double: convert it to PLY")
    in_text, start = header[1].upper() == b"ASCII", found.end()
    count, code = 3 * int(found[1]), np.dtype(_CODES[found[2].lower()])
    if count * (LEAST_DIGITS if in_text else code.itemsize) > len(contents) - start + in_text:
        raise SourceError(f"{path}: says {count // 3} points, which its bytes cannot hold: copy it again")
    values = _numbers(contents[start:], count) if in_text else np.frombuffer(contents, code, count, start)
    if len(values) != count:
        raise SourceError(f"{path}: says {count // 3} points, has {len(values) // 3}: copy it again")
    yield from parts_of(dict(zip("xyz", values.reshape(-1, 3).T, strict=True)))


def _numbers(text: bytes, count: int) -> Floats:
    """The first numbers (count,) of a text, none where something else stands among them."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", DeprecationWarning)
            return np.fromstring(text, float, count, sep=" ") if count else np.zeros(0)
    except (ValueError, DeprecationWarning):
        return np.zeros(0)
