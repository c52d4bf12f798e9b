"""The verdicts as a table that a spreadsheet opens."""

from __future__ import annotations

import csv
import io
from math import isfinite
from pathlib import Path

from hodge_pipeline.diagnosis.result import Diagnosis
from hodge_pipeline.errors import not_written
from hodge_pipeline.store import artifacts
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
        table.writerow((i, j, verdict, *(f"{v:.6g}" if isfinite(v) else "" for v in values), source, reason))
    try:
        artifacts.write_text(path, text.getvalue())
    except OSError as error:
        raise not_written(path, error) from error
