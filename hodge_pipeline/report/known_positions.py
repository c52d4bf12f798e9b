"""How known positions fit the result: notes, a table, numbers, and a CSV of their residuals."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from hodge_pipeline.complex.components import in_runs
from hodge_pipeline.evaluation.difference import length
from hodge_pipeline.report.document import Table
from hodge_pipeline.types import Floats
from hodge_pipeline.types.notes import Note
from hodge_pipeline.types.positions import PositionFit
from hodge_pipeline.types.text import cell, csv_text

SCATTER = 1.5
"""Times their stated sigma, from which positions are said to scatter more than that."""


def notes(fit: PositionFit) -> Iterator[Note]:
    """Notes on the world of the result, on rejected positions and on components that could not be placed."""
    if fit.used.any():
        yield Note("world", int(fit.used.sum()), fit.origin)
    if fit.rejected.any():
        yield Note("positions rejected", int(fit.rejected.sum()), in_runs(np.flatnonzero(fit.rejected), fit.labels))
    if fit.fix_factor > SCATTER:
        yield Note("positions scatter", detail=f"{fit.fix_factor:.1f}")
    yield from (Note("not placed", detail=problem) for problem in fit.problems)


def summary(fit: PositionFit) -> dict[str, Any]:
    """The numbers for `report.json`: counts, RMS residuals in metres, share within 3 sigma, factors on the sigmas."""
    east, north, up = _rms(fit).tolist()
    return {
        "positions": len(fit.used), "used": int(fit.used.sum()), "rejected": fit.labels[fit.rejected].tolist(),
        "off_e_m": east, "off_n_m": north, "off_u_m": up, "within_3_sigma": _within(fit),
        "edge_factor": fit.edge_factor, "position_factor": fit.fix_factor, "origin": fit.origin,
    }  # fmt: skip


def table(fit: PositionFit) -> Table:
    """The residuals of the positions used, as a table."""
    east, north, up = (length(value) for value in _rms(fit).tolist())
    rows = (
        ("used", f"{int(fit.used.sum())} of {len(fit.used)}"),
        ("rejected", str(int(fit.rejected.sum()))),
        ("off by, east / north / up", f"{east} / {north} / {up}"),
        ("within 3 sigma of what all others say", f"{_within(fit):.1%}"),
        ("factor on their sigma", f"{fit.fix_factor:.2g}"),
        ("factor on the sigma of edges", f"{fit.edge_factor:.2g}"),
    )
    caption = (
        "Positions known from elsewhere against the result: root mean square of those used; positions.csv lists each. "
        "Each is also predicted without itself, by the others and the edges. The factors are estimated from how far "
        "positions and edges scatter."
    )
    return Table("Known positions", ("what", "value"), rows, caption)


def as_csv(fit: PositionFit) -> str:
    """The positions with residuals in metres east, north, up, and in sigmas; empty where not placed."""
    rows: list[list[object]] = [["position", "e", "n", "u", "off_e", "off_n", "off_u", "sigmas", "status"]]
    status = np.where(fit.used, "used", np.where(fit.rejected, "rejected", "not placed"))
    numbers = np.column_stack([fit.points, fit.residuals, fit.distance]).round(4)
    for label, values, word in zip(fit.labels.tolist(), numbers.tolist(), status.tolist(), strict=True):
        rows.append([cell(label), *("" if np.isnan(value) else value for value in values), word])
    return csv_text(rows)


def _rms(fit: PositionFit) -> Floats:
    used = fit.residuals[fit.used]
    return np.asarray(np.sqrt((used**2).mean(axis=0))) if len(used) else np.full(3, np.nan)


def _within(fit: PositionFit) -> float:
    """The share of the positions used that are within 3 sigma of what all others say."""
    return float((fit.distance[fit.used] <= 3).mean()) if fit.used.any() else float("nan")
