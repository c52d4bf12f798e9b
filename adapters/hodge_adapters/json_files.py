"""JSON files that are not trusted: numbers and matrices are taken only where they are what they should be."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from hodge_adapters.text_rows import read_text, write_text_atomically
from hodge_pipeline import se3
from hodge_pipeline.errors import SourceError
from hodge_pipeline.types import Floats


def read_json(path: Path) -> dict[str, Any]:
    """The object in a file. Raises `SourceError` with the line where it is none."""
    try:
        content = json.loads(read_text(path))
    except json.JSONDecodeError as error:
        raise SourceError(f"{path}:{error.lineno}: not JSON ({error.msg}): copy the file again") from error
    except (ValueError, RecursionError) as error:
        raise SourceError(f"{path}: not JSON that can be read ({error}): copy the file again") from error
    if not isinstance(content, dict):
        raise SourceError(f"{path}: not a JSON object: is it another file?")
    return content


def objects(value: Any, where: str) -> list[dict[str, Any]]:
    """A list of objects. Raises `SourceError`."""
    if not isinstance(value, list) or not all(isinstance(item, dict) for item in value):
        raise SourceError(f"{where}: not a list of objects: is it another file?")
    return value


def number(value: Any) -> float | None:
    """A finite number, or None."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return None
    try:
        return float(value) if math.isfinite(value) else None
    except OverflowError:
        return None


def whole(value: Any, least: int, limit: int) -> int | None:
    """A whole number in [least, limit), or None."""
    found = number(value)
    return int(found) if found is not None and found.is_integer() and least <= found < limit else None


def numbers(value: Any, count: int, where: str) -> Floats:
    """So many finite numbers from a list, nested or flat. Raises `SourceError`."""
    flat = value if isinstance(value, list) else []
    if flat and all(isinstance(row, list) for row in flat):
        flat = [item for row in flat for item in row]
    found = [number(item) for item in flat] if len(flat) == count else [None]
    if any(item is None for item in found):
        raise SourceError(f"{where}: not {count} finite numbers: mend the file")
    return np.array(found, np.float64)


def motion(value: Any, where: str, *, columns: bool = False) -> Floats:
    """A rigid motion (4, 4) of sixteen numbers, by rows or by columns, its rotation made orthonormal.

    Raises `SourceError`.
    """
    matrix = numbers(value, 16, where).reshape(4, 4)
    matrix = matrix.T.copy() if columns else matrix
    if not se3.is_motion(matrix):
        raise SourceError(f"{where}: no rigid motion: mend the file")
    matrix[:3, :3] = se3.project_to_so3(matrix[:3, :3])
    return matrix


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Write the object atomically, with the digits that restore every number."""
    write_text_atomically(path, json.dumps(content, indent=1, allow_nan=False) + "\n")
