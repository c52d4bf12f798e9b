"""The report of a run: one page for people, the same numbers as JSON for programs."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

from hodge_pipeline.complex.energies import Energies
from hodge_pipeline.evaluation.scores import SIGMA_M, ScoreTable
from hodge_pipeline.report import known_positions
from hodge_pipeline.report.contents import RefinementSummary, Report
from hodge_pipeline.report.document import render
from hodge_pipeline.report.run_page import document
from hodge_pipeline.report.suspicions import suspicions
from hodge_pipeline.report.verdict import judge
from hodge_pipeline.store.artifacts import write_json, write_text
from hodge_pipeline.store.workspace import NUMBERS_FILE, PAGE_FILE

FORMAT_VERSION = 3
"""Raised when a key of `report.json` is renamed, moved or removed."""


def write_report(folder: Path, report: Report) -> tuple[Path, Path]:
    """Write `report.html` and `report.json` into a folder that exists, and give back their paths."""
    page, numbers = folder / PAGE_FILE, folder / NUMBERS_FILE
    write_text(page, render(document(report, str(folder))))
    write_json(numbers, as_json(report))
    return page, numbers


def as_json(report: Report) -> dict[str, Any]:
    """The numbers of a report under stable keys; lengths in metres, angles in degrees where the key says so."""
    verdict = judge(report)
    return {
        "format_version": FORMAT_VERSION,
        "title": report.title,
        "verdict": {
            "outcome": verdict.outcome,
            "sentence": verdict.sentence,
            "pieces": verdict.pieces,
            "before": report.before,
            "after": report.after,
            "changes": [{**asdict(change), "share": change.share} for change in verdict.changes],
        },
        "refinement": None if report.refinement is None else _refinement(report.refinement),
        "source": asdict(report.source),
        "scores": None if report.scores is None else _scores(report.scores),
        "trajectories": [asdict(row) for row in report.trajectories],
        "loops": [{**asdict(row), "mean": row.mean} for row in report.loops],
        "energies": [_energies(name, row) for name, row in report.energies.items()],
        "positions": None if report.position_fit is None else known_positions.summary(report.position_fit),
        "graph": None if report.graph is None else asdict(report.graph),
        "wrong_edges": None if report.wrong_edges is None else asdict(report.wrong_edges),
        "worst_edges": [asdict(row) for row in report.worst_edges],
        "convergence": {name: list(series) for name, series in report.pictures.convergence.items()},
        "stages": [asdict(row) for row in report.stages],
        "notes": [{"kind": note.kind, "count": note.count, "text": str(note)} for note in suspicions(report)],
        "versions": dict(report.versions),
        "recipe": report.recipe,
    }


def _energies(name: str, found: Energies) -> dict[str, Any]:
    rotation, translation = found.total
    total = {"rotation_rad2": rotation, "translation_m2": translation}
    return {"round": name, "simplices": found.simplices, **found.shares, **total}


def _refinement(refinement: RefinementSummary) -> dict[str, Any]:
    measures = [{**asdict(measure), "is_worse": measure.is_worse} for measure in refinement.measures]
    candidates = [
        {
            "name": name,
            "mean_px": cost.px,
            **{key: getattr(cost, key) for key in ("median_px", "observations", "behind", "distant", "beyond")},
            "images_off": len(cost.images_off),
            "is_kept": row == refinement.kept,
        }
        for row, (name, cost) in enumerate(refinement.candidates)
    ]
    told = {key: value for key, value in asdict(refinement).items() if key != "kept"}
    return {**told, "measures": measures, "candidates": candidates}


def _scores(table: ScoreTable) -> dict[str, Any]:
    return {
        "reference": table.reference,
        "sigma_m": table.scale * SIGMA_M,
        "graphs": {
            graph.kind: {
                "edges": len(graph.pairs),
                "poses": {
                    name: {
                        "score": graph.mean_score[row],
                        "distance_m": graph.mean_distance_m[row],
                        "edges_scored": graph.counts[row],
                        "edges_unmatched": graph.unmatched[row],
                    }
                    for row, name in enumerate(table.names)
                },
            }
            for graph in table.graphs
        },
    }
