"""The verdicts as a table that a spreadsheet opens."""

from __future__ import annotations

import csv
import io
import os
from pathlib import Path

import numpy as np

from hodge_pipeline.diagnosis.result import Diagnosis
from hodge_pipeline.errors import WorkspaceError
from hodge_pipeline.types import ViewGraph

HEADER = ("i", "j", "verdict", "probability", "residual_m", "residual_deg", "leverage", "source", "reason")


def write_edges_csv(path: Path, graph: ViewGraph, diagnosis: Diagnosis) -> None:
    """One row an edge, in the graph's order, by vertex ids; empty where there is no number. Written in one step.

    Raises `WorkspaceError` where the file cannot be written.
    """
    text = io.StringIO(newline="")
    table = csv.writer(text, lineterminator="\n")
    table.writerow(HEADER)
    columns = (diagnosis.probability, diagnosis.residual_m, diagnosis.residual_deg, diagnosis.leverage)
    numbers = zip(*(column.tolist() for column in columns), strict=True)
    ends = graph.vertex_ids[graph.edges].tolist()
    rest = zip(diagnosis.verdict.tolist(), graph.source.tolist(), diagnosis.reason, strict=True)
    for (i, j), values, (verdict, source, reason) in zip(ends, numbers, rest, strict=True):
        table.writerow((i, j, verdict, *("" if not np.isfinite(v) else f"{v:.6g}" for v in values), source, reason))
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        temporary.write_text(text.getvalue(), encoding="utf-8", newline="\n")
        temporary.replace(path)
    except OSError as error:
        temporary.unlink(missing_ok=True)
        raise WorkspaceError(f"{path}: cannot be written ({error.strerror}): is its folder there?") from error
