"""A run's report as a page: is it good, where is it worst, what now; then what it rests on."""

from __future__ import annotations

from hodge_pipeline.report.contents import Report
from hodge_pipeline.report.document import Banner, Document, Mark, Section
from hodge_pipeline.report.plots import draw, draw_convergence
from hodge_pipeline.report.suspicions import suspicions
from hodge_pipeline.report.tables import graph_tables, score_tables, source_table, stages_table, worst_edges_table
from hodge_pipeline.report.verdict import Outcome, capital, judge
from hodge_pipeline.report.words import duration, next_commands, peak, worst_places
from hodge_pipeline.types.notes import Rank
from hodge_pipeline.types.text import counted

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
            Section("Errors and graph", of, pictures=tuple(draw(report))),
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
    if (total := report.total) is not None:
        told.append(f"{duration(total.wall_s)}{peak(total)}")
    return f"{'; '.join(told)}."
