"""`hodge diagnose`: which edge of a run or a pose graph is wrong, why, and what to do about it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hodge_pipeline.cli.console import ProgressBars, print_json, print_table
from hodge_pipeline.cli.options import Shown
from hodge_pipeline.report.brief import LABEL, LINES, at_most, labelled, pointed
from hodge_pipeline.store.workspace import EDGES_FILE
from hodge_pipeline.types.text import counted, with_symbols

if TYPE_CHECKING:
    from hodge_pipeline.report.energy import EnergyRow
    from hodge_pipeline.uses.diagnosed import Diagnosed

SUGGESTED = 3
"""Pairs to register that `--verbose` names."""
LEAST_SHOWN, MOST_BAD = 3, 20
"""Rows of the table without `--top`: the edges that are not consistent, at least and at most so many."""
HEADER = ("edge", "verdict", "right", "why", "what to do")


def diagnose(path: Path, out: Path | None, shown: Shown, *, top: int | None, trust: str | None) -> None:
    """Judge every edge, print the worst, and leave the rest in a folder where one is given."""
    from hodge_pipeline.uses.diagnosed import diagnose_subject, open_subject

    with ProgressBars.of(shown) as terminal:
        with terminal.stage("diagnosis", 1):
            found = diagnose_subject(open_subject(path, trust))
        if out is not None:
            from hodge_pipeline.uses.diagnosis_folder import write_diagnosed

            with terminal.stage("pictures and recording", 1):
                write_diagnosed(out, found)
    if shown.as_json:
        print_json(_as_json(found, out))
    elif not shown.quiet:
        _print(found, out, top, verbose=shown.verbose)


def _print(found: Diagnosed, out: Path | None, top: int | None, *, verbose: bool) -> None:
    bad = int((found.diagnosis.verdict != "consistent").sum())
    if verbose:
        rows = found.rows[: min(MOST_BAD, max(LEAST_SHOWN, bad)) if top is None else top]
        print_table("Edges, the worst first", HEADER, [_cells(found, int(row)) for row in rows], words=HEADER)
        print("\n".join(_details(found)))
    print("\n".join(_lines(found, out, top, bad)))


def _details(found: Diagnosed) -> Iterator[str]:
    from hodge_pipeline.report.energy import CAVEAT, in_words

    for line in in_words(found.energy):
        yield from labelled("energy", line)
    for note in (*found.notes, *((CAVEAT,) if found.energy else ())):
        yield from labelled("note", note)
    for line in _to_register(found)[1:SUGGESTED]:
        yield from labelled("register", line)


def _to_register(found: Diagnosed) -> list[str]:
    """The pairs worth registering, and why, the best first."""
    useful = found.suggestions.score >= found.subject.suggestions.min_gain
    pairs = zip(_suggested(found), found.suggestions.reason[useful], strict=False)
    return [f"{i}-{j} {reason}" for (i, j), reason in pairs]


def _lines(found: Diagnosed, out: Path | None, top: int | None, bad: int) -> list[str]:
    """The verdict, the worst edges, a note and what to type next, in ten lines, or with `top` edges."""
    head = labelled("verdict", found.sentence)
    worrying = [note for note in found.notes if note not in found.diagnosis.notes]
    tail = [line for note in worrying[:1] for line in at_most(labelled("look", note), 3)]
    tail += [line for one in _to_register(found)[:1] if bad for line in at_most(labelled("register", one), 1)]
    tail += [] if out is None else [f"{'report':<{LABEL}}{out / 'diagnosis.html'}"]
    tail += [f"{'next':<{LABEL}}{with_symbols(command)}" for command in found.commands]
    shown = min(bad, LINES - len(head) - len(tail) - 1) if top is None else top
    points = []
    for row in found.rows[: max(shown, 0)].tolist():
        name, verdict, _, why, _ = _cells(found, row)
        points += pointed(f"{name} {verdict}: {why}")
    left = found.subject.graph.edge_count - len(points)
    if left and (points or top is not None):
        where = "--verbose" if out is None else str(out / EDGES_FILE)
        points.append(f"  - … and {counted(left, 'more edge')}, none of them worse: {where}")
    return [*head, *points, *tail]


def _suggested(found: Diagnosed) -> list[list[Any]]:
    """The pairs to register next, by the names of their vertices."""
    return [list(pair) for pair in found.subject.graph.vertex_ids[found.suggestions.pairs]]


def _cells(found: Diagnosed, row: int) -> tuple[str, ...]:
    graph, diagnosis = found.subject.graph, found.diagnosis
    i, j = graph.vertex_ids[graph.edges[row]]
    probability = diagnosis.probability[row]
    right = "-" if probability != probability else f"{probability:.2f}"
    return f"{i}-{j}", str(diagnosis.verdict[row]), right, diagnosis.reason[row], found.advice[row]


def _energy(row: EnergyRow) -> dict[str, Any]:
    from hodge_pipeline.report.energy import PARTS

    units = {"rotation": "rad2", "translation": "m2"}
    kinds = {
        kind: {units[kind]: energy, **dict(zip(PARTS, shares, strict=True))}
        for kind, (energy, shares) in row.kinds.items()
    }
    return {"edges_of": "all edges", "when": row.when, "edges": row.edges, **kinds}


def _as_json(found: Diagnosed, out: Path | None) -> dict[str, Any]:
    from hodge_pipeline.diagnosis.result import VERDICTS

    graph, diagnosis = found.subject.graph, found.diagnosis
    counts = {name: int((diagnosis.verdict == name).sum()) for name in VERDICTS}
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
        "in_metres": found.subject.has_metres,
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
