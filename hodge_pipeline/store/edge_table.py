"""The table of edges that people read: `edges.csv`, written and read."""

from __future__ import annotations

import csv
import io
from dataclasses import replace
from math import isfinite
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hodge_pipeline.errors import WorkspaceError, not_written
from hodge_pipeline.store import artifacts
from hodge_pipeline.types import Edges
from hodge_pipeline.types.arrays import Words
from hodge_pipeline.types.input_files import read_input
from hodge_pipeline.types.text import cell, cell_text, csv_text, with_symbols

COLUMNS = {
    "source": "proposed_by",
    "status": "status",
    "overlap": "overlap",
    "fitness": "fitness",
    "rmse_m": "rmse_m",
    "seen_through": "seen_through",
    "correspondences": "correspondences",
    "weight": "weight",
    "residual_m": "residual_m",
    "residual_deg": "residual_rad",
    "verdict": "verdict",
    "probability": "probability",
    "leverage": "leverage",
    "why": "why",
}
"""The columns after `i` and `j`, and the field of `Edges` that each shows."""
UNITS = {name: name.removesuffix("_m") + "_units" for name in COLUMNS if name.endswith("_m")}
"""What the columns of lengths are called where no scale is known."""
LEAST = ("i", "j", "source", "status")


def write_edges(path: Path, edges: Edges, vertex_ids: NDArray[np.generic], *, has_metres: bool = True) -> None:
    """One row a pair by vertex ids, the edges before those that are none; empty where nothing is known.

    Without `has_metres` columns in `_m` are called `_units`. Raises `WorkspaceError` where the file cannot be written.
    """
    edges = edges.select(np.argsort(~edges.in_graph, kind="stable"))
    columns = [_cells(name, getattr(edges, field)) for name, field in COLUMNS.items()]
    header = ("i", "j", *(COLUMNS if has_metres else [UNITS.get(name, name) for name in COLUMNS]))
    names = [cell(str(name)) if isinstance(name, str) else name for name in vertex_ids.tolist()]
    ends = [[names[vertex] for vertex in side] for side in edges.pairs.T.tolist()]
    # A lone \r ends a line for those who read the table, and the writer does not quote for it.
    has_returns = any("\r" in str(name) for name in vertex_ids)
    try:
        artifacts.write_text(path, csv_text([header, *zip(*ends, *columns, strict=True)], quoted=has_returns))
    except OSError as error:
        raise not_written(path, error) from error


def _cells(name: str, column: NDArray[Any]) -> list[Any]:
    if column.dtype.kind == "U":
        shown = {value: cell(with_symbols(value)) for value in set(column.tolist())}
        return [shown[value] for value in column.tolist()]
    if column.dtype.kind != "f":
        return list(column.tolist())
    values = (np.rad2deg(column) if name.endswith("_deg") else column).tolist()
    return [f"{value:.6g}" if isfinite(value) else "" for value in values]


def read_edges(path: Path) -> tuple[Edges, Words]:
    """What `write_edges` wrote but for the motions, and the names of the vertices.

    Raises `WorkspaceError` for a table without the ends, source and status of its rows.
    """
    try:
        rows = list(csv.DictReader(io.StringIO(read_input(path).decode("utf-8-sig"), newline="")))
    except (OSError, ValueError, csv.Error) as error:
        raise WorkspaceError(f"{path}: is no table of edges ({error}): run the same recipe again") from error
    header = ("i", "j", *COLUMNS) if not rows else tuple(rows[0])
    if missing := [name for name in LEAST if name not in header]:
        raise WorkspaceError(f"{path}: has no column {missing[0]!r}: run the same recipe again")
    names, ends = np.unique(
        np.array([(cell_text(row["i"]), cell_text(row["j"])) for row in rows], np.str_), return_inverse=True
    )
    edges = Edges.of(ends.reshape(-1, 2))
    called = {name: UNITS[name] if UNITS.get(name) in header else name for name in COLUMNS}
    columns = {
        field: [row[called[name]] or "" for row in rows] for name, field in COLUMNS.items() if called[name] in header
    }
    edges = replace(edges, **{field: _column(getattr(edges, field), cells) for field, cells in columns.items()})
    return replace(edges, residual_rad=np.deg2rad(edges.residual_rad)), names


def _column(like: NDArray[Any], cells: list[str]) -> NDArray[Any]:
    if like.dtype.kind == "U":
        return np.array([cell_text(text) for text in cells], np.str_)
    return np.array([float(cell or "nan") for cell in cells]).astype(like.dtype)
