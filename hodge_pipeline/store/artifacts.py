"""Dataclasses of arrays to files and back, without pickle, written atomically."""

from __future__ import annotations

import json
import math
import os
import shutil
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from hodge_pipeline.types.input_files import open_input, read_input_text
from hodge_pipeline.types.output_files import draft_of, replacing

T = TypeVar("T")


def write_text(path: Path, text: str) -> None:
    """Write UTF-8 text atomically; what is no text in a file name becomes its escape."""
    with replacing(path) as file:
        file.write(text.encode(errors="backslashreplace"))


def json_text(data: Any) -> str:
    """JSON with a line for each value; a number that is not finite becomes null."""
    return json.dumps(_finite(data), indent=1, allow_nan=False) + "\n"


def write_json(path: Path, data: Any) -> None:
    """Write JSON atomically (see `json_text`)."""
    write_text(path, json_text(data))


def link_or_copy(existing: Path, path: Path) -> None:
    """Give a file another name atomically: no second copy where the file system can link."""
    if path.exists() and os.path.samefile(existing, path):
        return  # a rename of one name of a file onto another does nothing and would leave the draft behind
    draft = draft_of(path)
    draft.unlink(missing_ok=True)
    try:
        os.link(existing, draft)
    except OSError:
        shutil.copyfile(existing, draft)
    os.replace(draft, path)
    draft.unlink(missing_ok=True)  # two names of one file are not replaced


def _finite(value: Any) -> Any:
    """The value with numpy scalars as Python ones and every number that is not finite as None."""
    if isinstance(value, Mapping):
        return {str(key): _finite(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(item) for item in value]
    if isinstance(value, np.ndarray):
        return _finite(value.tolist())
    if isinstance(value, np.generic):
        return _finite(value.item())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def read_json(path: Path) -> Any:
    """The value of a JSON file. Raises `ValueError` where it holds none, `OSError` where it cannot be read."""
    try:
        return json.loads(read_input_text(path))
    except RecursionError as error:
        raise ValueError("nested too deep") from error


def save_arrays(path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write named arrays as one uncompressed `.npz`, atomically."""
    with replacing(path) as file:
        np.savez(file, **arrays)  # type: ignore[arg-type]


def load_arrays(path: Path) -> dict[str, NDArray[Any]]:
    """The arrays of an `.npz`; nothing in it is executed."""
    with open_input(path) as stream, np.load(stream, allow_pickle=False) as file:
        return {name: file[name] for name in file.files}


def save(path: Path, value: Any) -> None:
    """Write a dataclass whose fields are all arrays or scalars; one that is None is left to its default."""
    columns = {field.name: getattr(value, field.name) for field in fields(value)}
    save_arrays(path, {name: np.asarray(column) for name, column in columns.items() if column is not None})


def load(path: Path, cls: type[T]) -> T:
    """The dataclass that `save` wrote; a scalar field comes back as a Python scalar."""
    arrays = load_arrays(path)
    return cls(**{name: array.item() if array.ndim == 0 else array for name, array in arrays.items()})
