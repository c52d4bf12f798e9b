"""A diagnosis as one HTML page that needs nothing but itself."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from html import escape

import numpy as np

from hodge_pipeline.complex.components import in_runs
from hodge_pipeline.diagnosis.advice import ranked
from hodge_pipeline.diagnosis.energy import CAVEAT, PARTS, SHARE_CAVEAT, EnergyRow
from hodge_pipeline.diagnosis.result import CONSISTENT, SUSPECT, UNTESTABLE, WRONG, Diagnosis
from hodge_pipeline.diagnosis.suggestions import Suggestions
from hodge_pipeline.diagnosis.wording import TOO_LONG, cycle_error, name_cycle
from hodge_pipeline.report.page import STYLE
from hodge_pipeline.report.plots import Plot
from hodge_pipeline.report.tables import Table, number
from hodge_pipeline.types import Floats, Ints, ViewGraph

LISTED = 20
CYCLES_EACH = 2
OUTCOMES = {WRONG: "worse", SUSPECT: "mixed", UNTESTABLE: "unchanged", CONSISTENT: "improved"}
EXTRA_STYLE = (
    ".wrong { color: #b0207a; font-weight: 600; } .suspect { color: #8a5a00; font-weight: 600; } "
    ".cycles { min-width: 17em; } "
)


@dataclass(frozen=True)
class EdgePictures:
    """Pictures of one edge, by its row: its clouds and its images, each with what it shows."""

    row: int
    plots: tuple[Plot, ...]


@dataclass(frozen=True)
class PageContents:
    """What the page is made of. `advice` has a line for each edge; `commands` are what to type next."""

    title: str
    path: str
    graph: ViewGraph
    diagnosis: Diagnosis
    advice: tuple[str, ...]
    energy: tuple[EnergyRow, ...]
    plots: tuple[Plot, ...]
    edges: tuple[EdgePictures, ...] = ()
    suggestions: Suggestions | None = None
    commands: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()


def render(contents: PageContents) -> str:
    """The page, as HTML5 text."""
    head = (
        f"<header><h1>Which edge is wrong: {escape(contents.title)}</h1>"
        f'<p class="soft">{escape(contents.path)}: {contents.graph.vertex_count} frames, {contents.graph.edge_count} '
        "edges. Each edge is a measured motion between two frames; the cycles that it lies in test it.</p></header>"
    )
    body = [
        head,
        _verdict(contents),
        _next(contents.commands),
        *(_edge_pictures(contents, edge) for edge in contents.edges),
        _table(edge_table(contents)),
        _figures("The graph", contents.plots),
        _suggestions(contents),
        *([_table(energy_table(contents.energy))] if contents.energy else []),
        _table(pieces_table(contents.graph, contents.diagnosis)),
        _notes(contents.notes),
    ]
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>Which edge is wrong: {escape(contents.title)}</title>\n<style>{STYLE}{EXTRA_STYLE}</style>\n</head>\n"
        "<body>\n" + "\n".join(part for part in body if part) + "\n</body>\n</html>\n"
    )


def sentence(graph: ViewGraph, diagnosis: Diagnosis) -> str:
    """The verdict on the whole graph in one sentence."""
    counts = {name: int((diagnosis.verdict == name).sum()) for name in (WRONG, SUSPECT, UNTESTABLE)}
    if not graph.edge_count:
        return "The graph has no edge: there is nothing to judge."
    if not any(counts.values()):
        return f"All {graph.edge_count} edges are consistent with each other."
    told = []
    if counts[WRONG]:
        worst = int(ranked(diagnosis)[0])
        i, j = graph.vertex_ids[graph.edges[worst]]
        told.append(f"{counts[WRONG]} {_are(counts[WRONG])} wrong, worst of all {i}–{j}")
    if counts[SUSPECT]:
        told.append(f"{counts[SUSPECT]} {_are(counts[SUSPECT])} suspect")
    told += _untestable(graph, diagnosis)
    return "; ".join(told).replace(" ", f" of {graph.edge_count} edges ", 1) + "."


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
        one = alone == 1
        told.append(
            f"{alone} {'lies' if one else 'lie'} in no loop, so that nothing can test {'it' if one else 'them'}"
        )
    if long:
        told.append(f"{long} {'lies' if long == 1 else 'lie'} in loops too long to be listed")
    return told


def _failing_loops(graph: ViewGraph, diagnosis: Diagnosis, blamed: Ints) -> str:
    loops = np.unique(diagnosis.witnesses_against[blamed, 0])
    loops = loops[loops >= 0]
    if len(loops) == 1:
        name = name_cycle(graph, diagnosis.cycles, int(loops[0]))
        return f"the loop {name}, which {cycle_error(diagnosis.cycles, int(loops[0]))}: nothing says which edge it is"
    return "loops that fail: nothing says which edges they are"


def _are(count: int) -> str:
    return "is" if count == 1 else "are"


def _verdict(contents: PageContents) -> str:
    verdict = contents.diagnosis.verdict
    worst = next((name for name in (WRONG, SUSPECT, UNTESTABLE) if (verdict == name).any()), CONSISTENT)
    pieces = int(contents.diagnosis.piece.max(initial=-1)) + 1
    rest = f" What is kept holds the scene in {pieces} pieces." if pieces > 1 else ""
    text = escape(sentence(contents.graph, contents.diagnosis) + rest)
    return f'<div class="verdict {OUTCOMES[worst]}"><b>{text}</b></div>'


def _next(commands: Sequence[str]) -> str:
    if not commands:
        return ""
    return f"<section><h2>What to do</h2><pre>{escape(chr(10).join(commands))}</pre></section>"


def _notes(notes: Sequence[str]) -> str:
    items = "".join(f"<li>{escape(note)}</li>" for note in notes)
    return f'<section><h2>Notes</h2><ul class="notes">{items}</ul></section>' if items else ""


def edge_table(contents: PageContents) -> Table:
    """The worst edges with the cycles for and against each."""
    graph, diagnosis = contents.graph, contents.diagnosis
    rows = tuple(_edge_row(contents, int(row)) for row in ranked(diagnosis)[:LISTED])
    caption = (
        f"The worst {len(rows)} of {graph.edge_count} edges; edges.csv has all of them. Right: the probability that "
        "the edge is right. Off by: distance from the robust poses, where its ends lie in one piece. Say: its share in "
        "where its ends lie; at 100 % the scene falls apart without it. Cycles: the product of motions around them."
    )
    header = ("edge", "verdict", "what to do", "cycles against", "cycles for", "source", "right", "off by", "say")
    return Table("Edges, the worst first", header, rows, caption, 6)


def _edge_row(contents: PageContents, row: int) -> tuple[str, ...]:
    graph, diagnosis = contents.graph, contents.diagnosis
    i, j = graph.vertex_ids[graph.edges[row]]
    off = number(diagnosis.residual_m[row] * 100, ".1f", " cm"), number(diagnosis.residual_deg[row], ".2f", "°")
    return (
        f"{i}–{j}",
        str(diagnosis.verdict[row]),
        contents.advice[row],
        _cycles(contents, diagnosis.witnesses_against[row]),
        _cycles(contents, diagnosis.witnesses_for[row]),
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
        told.setdefault(edges, f"{name_cycle(contents.graph, cycles, row)} {cycle_error(cycles, row)}")
    return "; ".join(list(told.values())[:CYCLES_EACH]) or "none"


def _suggestions(contents: PageContents) -> str:
    found = contents.suggestions
    if found is None or not len(found.pairs):
        return ""
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
    header = ("pair", "why", "nats", "resistance", "edges it tests")
    return _table(Table("Pairs to register next", header, tuple(rows), caption, 2))


def energy_table(rows: Sequence[EnergyRow]) -> Table:
    """Shares that add up to 100 %, with the energies themselves."""

    def cells(energy: Floats, shares: Floats, unit: str) -> tuple[str, ...]:
        return (*(f"{100 * share:.1f} %" for share in shares), f"{energy.sum():.3g} {unit}")

    body = tuple(
        (
            row.group,
            row.when,
            str(row.edges),
            *cells(row.rotation, row.shares[0], "rad²"),
            *cells(row.translation, row.shares[1], "m²"),
        )
        for row in rows
    )
    header = (
        "edges of",
        "when",
        "edges",
        *(f"rotation {part}" for part in PARTS),
        "energy",
        *(f"translation {part}" for part in PARTS),
        "energy",
    )
    caption = (
        "Before: all edges inside a piece. After: the edges that are kept. Exact: what moving frames would take away. "
        "Co-exact: curl, seen in triangles. Harmonic: around loops that no triangles fill. "
        f"{SHARE_CAVEAT} Caveat: {CAVEAT}."
    )
    return Table("Energy of the residual motions", header, body, caption, 2)


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


def _edge_pictures(contents: PageContents, edge: EdgePictures) -> str:
    i, j = contents.graph.vertex_ids[contents.graph.edges[edge.row]]
    verdict = str(contents.diagnosis.verdict[edge.row])
    reason = contents.diagnosis.reason[edge.row]
    figures = "".join(_figure(each) for each in edge.plots)
    return (
        f'<section><h2>{escape(f"{i}–{j}")}: <span class="{escape(verdict)}">{escape(verdict)}</span></h2>'
        f'<p class="caption">{escape(reason)}</p><div class="plots">{figures}</div></section>'
    )


def _figures(title: str, plots: Sequence[Plot]) -> str:
    figures = "".join(_figure(plot) for plot in plots)
    return f'<section><h2>{escape(title)}</h2><div class="plots">{figures}</div></section>' if figures else ""


def _figure(plot: Plot) -> str:
    kind = "jpeg" if plot.png.startswith(b"\xff\xd8") else "png"
    return (
        f'<figure><h3>{escape(plot.title)}</h3><img alt="{escape(plot.title)}. {escape(plot.caption)}" '
        f'src="data:image/{kind};base64,{b64encode(plot.png).decode()}">'
        f"<figcaption>{escape(plot.caption)}</figcaption></figure>"
    )


def _table(table: Table) -> str:
    def cells(tag: str, row: Sequence[str]) -> Iterator[str]:
        for column, cell in enumerate(row):
            known = (column < table.names, "word"), (cell in (WRONG, SUSPECT), cell), ("fails by" in cell, "cycles")
            classes = " ".join(name for applies, name in (*known, ("closes to" in cell, "cycles")) if applies)
            attribute = f' class="{classes}"' if classes else ""
            yield f"<{tag}{attribute}>{escape(cell)}</{tag}>"

    head = "".join(cells("th", table.header))
    rows = "".join(f"<tr>{''.join(cells('td', row))}</tr>" for row in table.rows)
    return (
        f'<section><h2>{escape(table.title)}</h2><p class="caption">{escape(table.caption)}</p><div class="scroll">'
        f"<table><thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table></div></section>"
    )
