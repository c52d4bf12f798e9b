"""A point cloud of named columns, as point-cloud files hold them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from hodge_pipeline.errors import SourceError
from hodge_pipeline.types import Bytes, Floats32, PointCloud

NORMALS = (("nx", "ny", "nz"), ("normal_x", "normal_y", "normal_z"))
COLOURS = ("red", "green", "blue")
MAX_METRES = 1e9


def points_of_columns(path: Path, columns: Mapping[str, Any]) -> PointCloud:
    """The cloud of the points that are finite. Raises `SourceError` where x, y or z is missing."""
    if not all(name in columns for name in "xyz"):
        raise SourceError(f"{path}: no x, y and z among {', '.join(columns) or 'nothing'}: give a file of points")
    points = _stack(columns, "xyz")
    with np.errstate(invalid="ignore"):
        finite = (np.abs(points) < MAX_METRES).all(axis=1)
    normals = next((_unit(_stack(columns, names)[finite]) for names in NORMALS if names[0] in columns), None)
    colours = _colours(columns)
    return PointCloud(points[finite], normals, None if colours is None else colours[finite])


def _stack(columns: Mapping[str, Any], names: str | tuple[str, ...]) -> Floats32:
    none = np.zeros(len(columns[names[0]]))
    with np.errstate(over="ignore", invalid="ignore"):
        return np.column_stack([columns.get(name, none) for name in names]).astype(np.float32)


def _unit(normals: Floats32) -> Floats32:
    """Unit normals, zero where there is none."""
    with np.errstate(over="ignore", invalid="ignore"):
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        good = np.isfinite(length) & (length > 1e-6)
        return np.where(good, normals / np.where(good, length, 1), np.float32(0)).astype(np.float32)


def _colours(columns: Mapping[str, Any]) -> Bytes | None:
    if not all(name in columns for name in COLOURS):
        return None
    values = np.column_stack([columns[name] for name in COLOURS])
    if columns["red"].dtype.kind == "f" and values.size and np.nanmax(values) <= 1:
        values = values * 255
    colours: Bytes = np.nan_to_num(np.clip(values, 0, 255)).astype(np.uint8)
    return colours
