"""A diagnosis as a page."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from hodge_pipeline.complex.components import in_runs
from hodge_pipeline.diagnosis.result import CONSISTENT, SUSPECT, UNTESTABLE, WRONG, Diagnosis
from hodge_pipeline.diagnosis.wording import TOO_LONG, cycle_error, name_cycle
from hodge_pipeline.evaluation.difference import length
from hodge_pipeline.report.advice import ranked
from hodge_pipeline.report.document import Banner, Document, Mark, Picture, Section, Table
from hodge_pipeline.report.energy import CAVEAT, PARTS, EnergyRow
from hodge_pipeline.report.tables import number
from hodge_pipeline.rounds.suggestions import Suggestions
from hodge_pipeline.types import Ints, ViewGraph
from hodge_pipeline.types.text import counted, in_unit, suiting

LISTED = 20
CYCLES_EACH = 2
"""Rows of a table, and cycles named in a row: what fits a page; `edges.csv` has all."""
NONE = "none"
MARKS: dict[str, Mark] = {WRONG: "worse", SUSPECT: "mixed", UNTESTABLE: "mixed", CONSISTENT: "better"}


@dataclass(frozen=True)
class EdgePictures:
    """Pictures of one edge, by its row: its clouds and its images, each with what it shows."""

    row: int
    plots: tuple[Picture, ...]


@dataclass(frozen=True)
class PageContents:
    """The contents of the page. `advice` has a line for each edge; `commands` are what to type next."""

    title: str
    graph: ViewGraph
    diagnosis: Diagnosis
    advice: tuple[str, ...]
    energy: tuple[EnergyRow, ...]
    plots: tuple[Picture, ...]
    edges: tuple[EdgePictures, ...] = ()
    suggestions: Suggestions | None = None
    commands: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    has_metres: bool = True


def document(contents: PageContents) -> Document:
    """The page."""
    verdict = contents.diagnosis.verdict
    worst = next((name for name in (WRONG, SUSPECT, UNTESTABLE) if (verdict == name).any()), CONSISTENT)
    pieces = int(contents.diagnosis.piece.max(initial=-1)) + 1
    rest = (f"What is kept holds the scene in {pieces} pieces.",) if pieces > 1 else ()
    frames = frames_table(contents.graph, contents.diagnosis)
    return Document(
        f"Which edge is wrong: {contents.title}",
        f"{counted(contents.graph.vertex_count, 'frame')}, {counted(contents.graph.edge_count, 'edge')}. Each "
        "edge is a measured motion "
        "between two frames; the cycles that it lies in test it.",
        (
            Banner(
                MARKS[worst], in_unit(sentence(contents.graph, contents.diagnosis), contents.has_metres), rest, worst
            ),
        ),
        first=(Section("What to do", text="\n".join(contents.commands)),),
        sections=(
            *([Section.of(frames)] if frames.rows else []),
            *(_edge_pictures(contents, edge) for edge in contents.edges),
            Section.of(edge_table(contents)),
            Section("The graph", pictures=contents.plots),
            *_suggestions(contents),
            *([Section.of(energy_table(contents.energy, contents.has_metres))] if contents.energy else []),
            Section.of(pieces_table(contents.graph, contents.diagnosis)),
            Section("Notes", lines=contents.notes, is_folded=True),
        ),
    )


def sentence(graph: ViewGraph, diagnosis: Diagnosis) -> str:
    """The verdict on the whole graph in one sentence."""
    counts = {name: int((diagnosis.verdict == name).sum()) for name in (WRONG, SUSPECT, UNTESTABLE)}
    if not graph.edge_count:
        return "The graph has no edge: there is nothing to judge."
    if not any(counts.values()):
        return "; ".join((f"All {graph.edge_count} edges are consistent with each other", *diagnosis.findings)) + "."
    told = []
    if counts[WRONG]:
        worst = int(ranked(diagnosis)[0])
        i, j = graph.vertex_ids[graph.edges[worst]]
        told.append(f"{counted(counts[WRONG], 'is|are')} wrong, worst of all {i}–{j}")
    if counts[SUSPECT]:
        told.append(f"{counted(counts[SUSPECT], 'is|are')} suspect")
    told += _untestable(graph, diagnosis)
    told[0] = told[0].replace(" ", f" of {graph.edge_count} edges ", 1)
    return "; ".join((*told, *diagnosis.findings)) + "."


def _untestable(graph: ViewGraph, diagnosis: Diagnosis) -> list[str]:
    untestable = diagnosis.verdict == UNTESTABLE
    in_cycle = np.zeros(graph.edge_count, bool)
    in_cycle[diagnosis.cycles.loops.edge] = True
    blamed, long = np.flatnonzero(untestable & in_cycle), diagnosis.reason.count(TOO_LONG)
    alone = int((untestable & ~in_cycle).sum()) - long
    told = []
    if len(blamed):
        told.append(f"{len(blamed)} may be to blame for {_failing_loops(graph, diagnosis, blamed)}")
    if alone:
        told.append(f"{counted(alone, 'lies|lie')} in no loop, so that nothing can test {suiting(alone, 'it|them')}")
    if long:
        told.append(f"{counted(long, 'lies|lie')} in loops too long to be listed")
    return told


def _failing_loops(graph: ViewGraph, diagnosis: Diagnosis, blamed: Ints) -> str:
    loops = np.unique(diagnosis.witnesses_against[blamed, 0])
    loops = loops[loops >= 0]
    if len(loops) == 1:
        name = name_cycle(graph, diagnosis.cycles, int(loops[0]))
        return f"the loop {name}, which {cycle_error(diagnosis.cycles, int(loops[0]))}: nothing says which edge it is"
    return "loops that fail: nothing says which edges they are"


def frames_table(graph: ViewGraph, diagnosis: Diagnosis) -> Table:
    """The frames that several wrong or suspect edges share, most first: one bad frame spoils all its edges."""
    bad = np.flatnonzero(np.isin(diagnosis.verdict, (WRONG, SUSPECT)))
    counts = np.bincount(graph.edges[bad].ravel(), minlength=graph.vertex_count)
    order = np.argsort(-counts, kind="stable")
    rows = tuple(_frame_row(graph, bad, int(frame)) for frame in order[:LISTED] if counts[frame] > 1)
    caption = "Where many of a frame's edges are bad look at the frame: its depth, blur, or a place that looks alike."
    return Table("Frames that bad edges share", ("frame", "bad edges", "of its edges", "to"), rows, caption, wide=(3,))


def _frame_row(graph: ViewGraph, bad: Ints, frame: int) -> tuple[str, ...]:
    own = bad[(graph.edges[bad] == frame).any(axis=1)]
    others = np.where(graph.edges[own, 0] == frame, graph.edges[own, 1], graph.edges[own, 0])
    total = int((graph.edges == frame).any(axis=1).sum())
    return str(graph.vertex_ids[frame]), str(len(own)), str(total), in_runs(np.unique(others), graph.vertex_ids)


def edge_table(contents: PageContents) -> Table:
    """The worst edges with the cycles for and against each."""
    graph, diagnosis = contents.graph, contents.diagnosis
    rows = tuple(_edge_row(contents, int(row)) for row in ranked(diagnosis)[:LISTED])
    caption = (
        f"The worst {len(rows)} of {graph.edge_count} edges; edges.csv has all of them. Right: the probability that "
        "the edge is right. Off by: distance from the robust poses, where its ends lie in one piece. Leverage: its "
        "share in the relative pose of its ends; at 100 % the scene falls apart without it. Cycles: the product of "
        "motions around them."
    )
    header: tuple[str, ...]
    header = ("edge", "verdict", "what to do", "cycles against", "cycles for", "source", "right", "off by", "leverage")
    if all(row[4] == NONE for row in rows):  # of loops on a backbone: the column would push numbers off the page
        header, rows = header[:4] + header[5:], tuple(row[:4] + row[5:] for row in rows)
    return Table("Edges, the worst first", header, rows, caption, header.index("right"), wide=(3, 4)[: len(header) - 7])


def _edge_row(contents: PageContents, row: int) -> tuple[str, ...]:
    graph, diagnosis = contents.graph, contents.diagnosis
    i, j = graph.vertex_ids[graph.edges[row]]
    far, degrees = diagnosis.residual_m[row], number(diagnosis.residual_deg[row], ".2f", "°")
    off = length(far) if contents.has_metres else number(far, ".3g"), degrees
    return (
        f"{i}–{j}",
        str(diagnosis.verdict[row]),
        contents.advice[row],
        _cycles(contents, diagnosis.witnesses_against[row]) or _without_cycle(contents, row),
        _cycles(contents, diagnosis.witnesses_for[row]) or NONE,
        str(graph.source[row]),
        number(100 * diagnosis.probability[row], ".0f", " %"),
        ", ".join(off) if np.isfinite(diagnosis.residual_m[row]) else "–",
        number(100 * diagnosis.leverage[row], ".0f", " %"),
    )


def _cycles(contents: PageContents, rows: Ints) -> str:
    cycles = contents.diagnosis.cycles
    told: dict[frozenset[int], str] = {}
    for row in rows[rows >= 0].tolist():
        # one cycle may be listed twice, begun elsewhere
        edges = frozenset(cycles.loops.edge[cycles.loops.offsets[row] : cycles.loops.offsets[row + 1]].tolist())
        error = in_unit(cycle_error(cycles, row), contents.has_metres)
        told.setdefault(edges, f"{name_cycle(contents.graph, cycles, row)} {error}")
    return "; ".join(list(told.values())[:CYCLES_EACH])


def _without_cycle(contents: PageContents, row: int) -> str:
    """The reason for the verdict on a bad edge without a listed cycle, such as a backbone."""
    is_bad = contents.diagnosis.verdict[row] in (WRONG, SUSPECT)
    return in_unit(contents.diagnosis.reason[row], contents.has_metres) if is_bad else NONE


def _suggestions(contents: PageContents) -> Iterator[Section]:
    found = contents.suggestions
    if found is None or not len(found.pairs):
        return
    rows = []
    for (i, j), score, resistance, tests, reason in zip(
        contents.graph.vertex_ids[found.pairs].tolist(),
        found.score,
        found.resistance,
        found.tests,
        found.reason,
        strict=True,
    ):
        far = number(resistance, ".2f") if np.isfinite(resistance) else "∞"
        rows.append((f"{i}–{j}", reason, f"{score:.2f}", far, str(tests)))
    caption = (
        "Pairs without an edge, ranked by what one would tell: the uncertainty it would take away, and the untestable "
        "edges it would put into a triangle. Resistance: variance between the two, in units of one edge's."
    )
    header = ("pair", "why", "score, nats", "resistance", "edges it tests")
    yield Section.of(Table("Pairs to register next", header, tuple(rows), caption, 2))


def energy_table(rows: Sequence[EnergyRow], has_metres: bool) -> Table:
    """Shares that add up to 100 %, with the energies themselves."""
    units = {"rotation": "rad²", "translation": "m²" if has_metres else "units²"}
    body = []
    for row in rows:
        cells = [row.when, str(row.edges)]
        for kind, (energy, shares) in row.kinds.items():
            cells += [*(f"{100 * share:.1f} %" for share in shares), f"{energy:.3g} {units[kind]}"]
        body.append(tuple(cells))
    header = ("when", "edges", *(cell for kind in units for cell in (*(f"{kind} {part}" for part in PARTS), "energy")))
    caption = (
        "Before: all edges inside a piece. After: the edges that are kept. Exact: what moving frames would take away. "
        "Co-exact: curl, seen in triangles. Harmonic: around loops that no triangles fill. "
        f"Caveat: {CAVEAT}."
    )
    return Table("Energy of the residual motions", header, tuple(body), caption, 1)


def pieces_table(graph: ViewGraph, diagnosis: Diagnosis) -> Table:
    """The pieces that the kept edges hold together."""
    count = int(diagnosis.piece.max(initial=-1)) + 1
    rows = [
        (str(number), str(len(members)), in_runs(members, graph.vertex_ids))
        for number in range(min(count, LISTED))
        for members in [np.flatnonzero(diagnosis.piece == number)]
    ]
    caption = "Frames that edges which are kept connect. poses.tum has each piece in a frame of its own."
    more = f" {count - LISTED} more pieces are not listed." if count > LISTED else ""
    return Table("Pieces", ("piece", "frames", "which"), tuple(rows), caption + more, 3)


def _edge_pictures(contents: PageContents, edge: EdgePictures) -> Section:
    i, j = contents.graph.vertex_ids[contents.graph.edges[edge.row]]
    verdict, reason = str(contents.diagnosis.verdict[edge.row]), contents.diagnosis.reason[edge.row]
    return Section(f"{i}–{j}", reason, pictures=edge.plots, mark=verdict)
