"""A run's report as a page: is it good, where is it worst, what now; then what it rests on."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from hodge_pipeline.report.contents import Report
from hodge_pipeline.report.document import Banner, Document, Mark, Section
from hodge_pipeline.report.painting import has_truth, offsets
from hodge_pipeline.report.plots import draw, draw_convergence
from hodge_pipeline.report.tables import (
    graph_tables,
    peak_mb,
    score_tables,
    source_table,
    stages_table,
    worst_edges_table,
)
from hodge_pipeline.report.verdict import Outcome, capital, judge, suspicions
from hodge_pipeline.types.notes import Rank
from hodge_pipeline.types.text import command, counted

MARKS: dict[Outcome, Mark] = {
    "improved": "better", "unchanged": "same", "worse": "worse", "mixed": "mixed", "not measured": "not measured",
}  # fmt: skip
FIRST = 4
"""Notes above the fold."""


def document(report: Report, folder: str) -> Document:
    """The page of a report that lies in this folder, which the commands to type name."""
    verdict = judge(report)
    told = suspicions(report)
    worrying = [capital(str(note)) for note in told if note.rank < Rank.FACT]
    facts = tuple(capital(str(note)) for note in told if note.rank == Rank.FACT)
    pictures = report.pictures
    of = "Result is the refinement here, which is not kept." if report.shows_rejected else ""
    return Document(
        report.title,
        _subtitle(report),
        (Banner(MARKS[verdict.mark], verdict.headline, verdict.points),),
        (
            Section("Where it is worst", lines=(*worst_places(report), *worrying[:FIRST]) or ("Nothing suspicious.",)),
            Section("What now", text="\n".join(next_commands(report, folder))),
        ),
        (
            Section("The place that changed most", of, pictures=pictures.changed_most, is_large=True),
            Section("What else to look at", lines=tuple(worrying[FIRST:])),
            Section("Errors and graph", of, pictures=draw(report)),
            *(Section.of(table) for table in score_tables(report)),
            Section(
                "The scene from four sides",
                f"The frames' clouds laid together by their poses: {report.before} on the left, {report.after} on "
                f"the right. {of}".rstrip(),
                pictures=pictures.sides,
            ),
            *([Section.of(worst_edges_table(report))] if report.worst_edges else []),
            Section("Frames of the worst edges", pictures=pictures.worst_pairs),
            Section("Notes", lines=facts, is_folded=True),
            *(Section.of(table, is_folded=True) for table in graph_tables(report)),
            Section("Convergence", pictures=draw_convergence(report), is_folded=True),
            Section.of(source_table(report), is_folded=True),
            *([Section.of(stages_table(report), is_folded=True)] if report.stages else []),
            Section("Versions", text="\n".join(f"{n} {v}" for n, v in report.versions.items()), is_folded=True),
            Section("Recipe", text=report.recipe, is_folded=True),
        ),
    )


def _subtitle(report: Report) -> str:
    source, graph = report.source, report.graph
    sequences = f" in {len(source.sequences)} sequences" if len(source.sequences) > 1 else ""
    truth = f"{source.frames_with_truth} with a true pose" if source.frames_with_truth else "no true poses"
    form = f"Format {source.format}: " if source.format else ""
    told = [f"{form}{source.counted}{sequences}, {truth}"]
    if graph is not None:
        parts = len(graph.components)
        told.append(f"{counted(graph.edges, 'edge')}, {counted(parts, 'connected part')}")
    if report.stages:
        told.append(f"{duration(sum(stage.wall_s for stage in report.stages))}{peak(report)}")
    return f"{'; '.join(told)}."


def peak(report: Report) -> str:
    """`, at most 800 MB`; nothing where memory was not measured."""
    memory = peak_mb(report)
    return f", at most {memory:.0f} MB" if np.isfinite(memory) else ""


def worst_places(report: Report) -> Iterator[str]:
    """The frame and the edge that are worst, a line each, where they were measured."""
    errors = offsets(report).get(report.after)
    if errors is not None and len(report.pictures.names) == len(errors):
        size = np.linalg.norm(errors, axis=1)
        row = int(np.nanargmax(size))
        name, off = f"{report.source.vertex} {report.pictures.names[row]}", report.length(float(size[row]))
        what = f"lies {off} off the truth" if has_truth(report) else f"was moved by {off}"
        where = "in the refinement, which is not kept, " if report.shows_rejected else ""
        yield capital(f"{where}{name} {what}, more than any other.")
    used = [edge for edge in report.worst_edges if edge.weight > 0]
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
