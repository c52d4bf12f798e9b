"""What a report's page and the terminal both say: what a run took, where it is worst, and what to type next."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from hodge_pipeline.report.contents import Report, StageRow
from hodge_pipeline.report.error_plots import has_truth, offsets
from hodge_pipeline.report.verdict import capital
from hodge_pipeline.types.text import command

EXACT = 1e-9
"""Metres and degrees: what is below is arithmetic, as of edges that no loop passes (1e-17 to 1e-13), or of frames that
are each aligned by itself."""


def peak(total: StageRow) -> str:
    """`, at most 800 MB`; nothing where memory was not measured."""
    return f", at most {total.peak_mb:.0f} MB" if np.isfinite(total.peak_mb) else ""


def worst_places(report: Report) -> Iterator[str]:
    """The frame and the edge that are worst, a line each, where they were measured."""
    errors = np.linalg.norm(offsets(report).get(report.after, np.zeros((0, 3))), axis=1)
    of_all = next((row for row in report.trajectories if row.name == report.after and row.worst), None)
    if of_all is not None and not report.shows_rejected:
        beside = max(row.ate_rmse_m for row in report.trajectories if row.frames)  # whose unit the table's ATEs have
        off = report.length(of_all.ate_max_m, beside)
        yield f"Frame {of_all.worst} lies {off} off the truth, more than any other."
    elif len(report.pictures.names) == len(errors) and np.nanmax(errors, initial=0.0) > EXACT:
        row = int(np.nanargmax(errors))
        name, off = f"{report.source.vertex} {report.pictures.names[row]}", report.length(float(errors[row]))
        what = f"lies {off} off the truth" if has_truth(report) else f"was moved by {off}"
        where = "in the refinement, which is not kept, " if report.shows_rejected else ""
        yield capital(f"{where}{name} {what}, more than any other.")
    used = [edge for edge in report.worst_edges if edge.weight > 0 and max(edge.residual_m, edge.residual_deg) > EXACT]
    if used:
        off = f"{report.length(used[0].residual_m)} and {used[0].residual_deg:.2g}°"
        verdict = f" ({used[0].verdict})" if used[0].verdict else ""
        yield f"Of the edges that count, {used[0].i}–{used[0].j}{verdict} fits least: it is {off} off the result."


def next_commands(report: Report, folder: str) -> Iterator[str]:
    """What to type next, each with why."""
    yield from ("# see it in 3-D, in the browser", command("hodge", "view", folder, "--web"))
    if report.verdicts_of_concern or len(report.pieces) > 1:
        yield from (
            "# which edges are wrong, and what to do",
            command("hodge", "diagnose", folder, "--out", f"{folder}-why"),
        )
    if report.wrong_edges is not None and report.wrong_edges.matters(report.scale):
        yield "# leave the wrong edges out; solve and fuse again"
        yield from (command("hodge", "edit", folder, "--disable", "wrong"), command("hodge", "solve", folder))


def duration(seconds: float) -> str:
    """A time with a unit that suits its size."""
    if seconds < 120:
        return f"{seconds:.1f} s"
    return f"{seconds / 60:.1f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"
