"""`hodge diagnose`: which edge of a run or a pose graph is wrong, why, and what to do about it."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hodge_pipeline.cli.console import ProgressBars

if TYPE_CHECKING:
    from hodge_pipeline.diagnosis.energy import EnergyRow
    from hodge_pipeline.uses.diagnosed import Diagnosed

SUGGESTED = 3
LEAST_SHOWN, MOST_BAD = 3, 20
"""Rows of the table where nobody says how many: the edges that are not consistent, and a few in any case."""
HEADER = ("edge", "verdict", "right", "why", "what to do")


def diagnose(path: Path, out: Path | None, *, top: int | None, trust: str | None, quiet: bool, as_json: bool) -> None:
    """Judge every edge, print the worst, and leave the rest in a folder where one is given."""
    from hodge_pipeline.uses.diagnosed import diagnose_subject, open_subject, write_diagnosed

    with ProgressBars(quiet or as_json) as terminal:
        with terminal.stage("diagnosis", 1):
            found = diagnose_subject(open_subject(path, trust))
        if out is not None:
            with terminal.stage("pictures and recording", 1):
                write_diagnosed(out, found)
    if as_json:
        from hodge_pipeline.store.artifacts import json_text

        print(json_text(_as_json(found, out)), end="")
    elif not quiet:
        _print(found, out, top)


def _print(found: Diagnosed, out: Path | None, top: int | None) -> None:
    from hodge_pipeline.diagnosis.energy import CAVEAT, in_words
    from hodge_pipeline.report.diagnosis_page import sentence

    if top is None:
        top = min(MOST_BAD, max(LEAST_SHOWN, int((found.diagnosis.verdict != "consistent").sum())))
    rows = [_cells(found, int(row)) for row in found.rows[:top]]
    if sys.stdout.isatty():
        _print_rich(rows)
    else:
        widths = [max((len(cells[column]) for cells in rows), default=0) for column in range(3)]
        for cells in rows:
            first = "  ".join(cell.ljust(width) for cell, width in zip(cells, widths, strict=False))
            print(f"{first}  {cells[3]}  -> {cells[4]}")
    left = found.subject.graph.edge_count - len(rows)
    if left > 0:
        print(f"… and {left} more edges, none of them worse" + ("" if out is None else f": {out / 'edges.csv'}"))
    print(f"verdict  {sentence(found.subject.graph, found.diagnosis)}")
    for line in in_words(found.energy):
        print(f"energy   {line}")
    for note in (*found.notes, *((CAVEAT,) if found.energy else ())):
        print(f"note     {note}")
    useful = found.suggestions.score >= found.subject.suggestions.min_gain
    for (i, j), reason in list(zip(_suggested(found), found.suggestions.reason[useful], strict=False))[:SUGGESTED]:
        print(f"register {i}-{j}  {reason}")
    for command in found.commands:
        print(f"next     {command}")
    if out is not None:
        print(f"report   {out / 'diagnosis.html'}")


def _suggested(found: Diagnosed) -> list[list[Any]]:
    """The pairs to register next, by the names of their vertices."""
    return [list(pair) for pair in found.subject.graph.vertex_ids[found.suggestions.pairs]]


def _cells(found: Diagnosed, row: int) -> tuple[str, ...]:
    graph, diagnosis = found.subject.graph, found.diagnosis
    i, j = graph.vertex_ids[graph.edges[row]]
    probability = diagnosis.probability[row]
    right = "-" if probability != probability else f"{probability:.2f}"
    return f"{i}-{j}", str(diagnosis.verdict[row]), right, diagnosis.reason[row], found.advice[row]


def _print_rich(rows: list[tuple[str, ...]]) -> None:
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    from hodge_pipeline.cli.guard import unguarded
    from hodge_pipeline.types.text import visible

    styles = {"wrong": "bold magenta", "suspect": "yellow", "untestable": "dim", "consistent": "blue"}
    table = Table(title="Edges, the worst first", title_justify="left")
    for name in HEADER:
        table.add_column(name, justify="right" if name == "right" else "left", overflow="fold")
    for cells in rows:
        table.add_row(*(Text(visible(cell)) for cell in cells), style=styles.get(cells[1], ""))
    Console(highlight=False, file=unguarded(sys.stdout)).print(table)


def _energy(row: EnergyRow) -> dict[str, Any]:
    from hodge_pipeline.diagnosis.energy import PARTS

    rotation, translation = (dict(zip(PARTS, shares.tolist(), strict=True)) for shares in row.shares)
    return {
        "edges_of": row.group,
        "when": row.when,
        "edges": row.edges,
        "rotation": {"rad2": float(row.rotation.sum()), **rotation},
        "translation": {"m2": float(row.translation.sum()), **translation},
    }


def _as_json(found: Diagnosed, out: Path | None) -> dict[str, Any]:
    graph, diagnosis = found.subject.graph, found.diagnosis
    counts = {name: int((diagnosis.verdict == name).sum()) for name in ("consistent", "suspect", "wrong", "untestable")}
    edges = [
        {
            "i": graph.vertex_ids[graph.edges[row, 0]],
            "j": graph.vertex_ids[graph.edges[row, 1]],
            "verdict": str(diagnosis.verdict[row]),
            "probability": diagnosis.probability[row],
            "why": diagnosis.reason[row],
            "what_to_do": found.advice[row],
            "source": str(graph.source[row]),
            "residual_m": diagnosis.residual_m[row],
            "residual_deg": diagnosis.residual_deg[row],
            "leverage": diagnosis.leverage[row],
        }
        for row in map(int, found.rows)
    ]
    return {
        "source": str(found.subject.path),
        "out": None if out is None else str(out),
        "vertices": graph.vertex_count,
        "pieces": int(diagnosis.piece.max(initial=-1)) + 1,
        "counts": counts,
        "energy": [_energy(row) for row in found.energy],
        "commands": list(found.commands),
        "register_next": [
            {"i": i, "j": j, "why": reason, "score": score}
            for (i, j), reason, score in zip(
                _suggested(found), found.suggestions.reason, found.suggestions.score, strict=True
            )
        ],
        "notes": list(found.notes),
        "edges": edges,
    }
