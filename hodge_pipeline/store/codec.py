"""Typed values to a folder and back: dataclasses, arrays, clouds and paths, without pickle."""

from __future__ import annotations

import dataclasses
import json
import math
import types
import typing
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import NDArray

from hodge_pipeline.store import artifacts
from hodge_pipeline.types import CloudSet

TEXT, ARRAYS, CLOUDS = "value.json", "value.npz", "clouds"
"""The shape of a value with its texts and numbers; its arrays by their place in it; the folder of a value's clouds."""


def save(folder: Path, value: Any) -> None:
    """Write a value into a folder that exists: a `CloudSet` as columns to be mapped, a `Path` in the folder by name.

    Raises `TypeError` for what `load` could not read back.
    """
    arrays: dict[str, NDArray[Any]] = {}
    text = json.dumps(_plain(folder, value, "", arrays))
    if arrays:
        artifacts.save_arrays(folder / ARRAYS, arrays)
    artifacts.write_text(folder / TEXT, text + "\n")


def load(folder: Path, kind: Any) -> Any:
    """The value of type `kind` that `save` wrote: types come from the code, never from the file.

    Raises `ValueError` or `OSError` where the folder holds something else.
    """
    arrays = artifacts.load_arrays(folder / ARRAYS) if (folder / ARRAYS).is_file() else {}
    try:
        return _typed(folder, artifacts.read_json(folder / TEXT), kind, arrays)
    except (KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"{folder / TEXT}: does not hold what was expected ({error})") from error


def _plain(folder: Path, value: Any, place: str, arrays: dict[str, NDArray[Any]]) -> Any:
    if isinstance(value, np.ndarray):
        if value.dtype.hasobject:
            raise TypeError(f"{place or 'value'}: an array of objects cannot be stored")
        arrays[place or "array"] = value
        return {"array": place or "array"}
    if isinstance(value, bytes):
        arrays[place or "bytes"] = np.frombuffer(value, np.uint8)
        return {"bytes": place or "bytes"}
    if isinstance(value, CloudSet):
        own = value.stored_in
        if own is None or own.parent != folder:
            own = folder / (place or CLOUDS)
            value.save(own)
        return {"clouds": own.name}
    if isinstance(value, Path):
        return str(value.relative_to(folder))
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        return {"float": repr(value)}
    if value is None or isinstance(value, (str, int, float, bool)):
        return value
    if dataclasses.is_dataclass(value):
        names = [field.name for field in dataclasses.fields(value)]
        return {name: _plain(folder, getattr(value, name), _place(place, name), arrays) for name in names}
    if isinstance(value, Mapping):
        return {str(key): _plain(folder, item, _place(place, str(key)), arrays) for key, item in value.items()}
    if isinstance(value, Sequence):
        return [_plain(folder, item, _place(place, str(row)), arrays) for row, item in enumerate(value)]
    raise TypeError(f"{place or 'value'}: a {type(value).__name__} cannot be stored")


def _place(place: str, name: str) -> str:
    return f"{place}.{name}" if place else name


def _typed(folder: Path, plain: Any, kind: Any, arrays: Mapping[str, NDArray[Any]]) -> Any:
    origin, parts = get_origin(kind), get_args(kind)
    if origin in (typing.Union, types.UnionType):
        if plain is None:
            return None
        return _typed(folder, plain, next(part for part in parts if part is not type(None)), arrays)
    if isinstance(plain, dict) and list(plain) == ["array"]:
        return arrays[plain["array"]]
    if isinstance(plain, dict) and list(plain) == ["bytes"]:
        return arrays[plain["bytes"]].tobytes()
    if isinstance(plain, dict) and list(plain) == ["float"]:
        return float(plain["float"])
    if kind is CloudSet:
        return CloudSet.open(_inside(folder, plain["clouds"]))
    if kind is Path:
        return _inside(folder, plain)
    if dataclasses.is_dataclass(kind) and isinstance(kind, type):
        hints = _types_of(kind)
        if lost := [name for name in _needed(kind) if name not in plain]:
            raise ValueError(f"{kind.__name__} without {', '.join(lost)}: another version wrote it")
        return kind(**{name: _typed(folder, item, hints[name], arrays) for name, item in plain.items()})
    if origin is tuple:
        item = [parts[0]] * len(plain) if parts[-1] is ... else list(parts)
        return tuple(_typed(folder, each, one, arrays) for each, one in zip(plain, item, strict=True))
    if isinstance(plain, list):
        return [_typed(folder, each, parts[0], arrays) for each in plain]
    if isinstance(plain, dict):
        return {key: _typed(folder, each, parts[1], arrays) for key, each in plain.items()}
    return plain


@cache  # `get_type_hints` compiles what each field is annotated with
def _types_of(kind: type) -> dict[str, Any]:
    return get_type_hints(kind)


def _needed(kind: Any) -> list[str]:
    """The fields of a dataclass without a default."""
    no_default = dataclasses.MISSING
    return [
        field.name
        for field in dataclasses.fields(kind)
        if field.default is no_default and field.default_factory is no_default
    ]


def _inside(folder: Path, name: str) -> Path:
    path = folder / name
    if not path.resolve().is_relative_to(folder.resolve()):
        raise ValueError(f"{folder / TEXT}: names a path outside its folder ({name})")
    return path
