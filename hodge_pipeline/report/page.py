"""A report as one HTML page that needs nothing but itself: it opens from a mail, prints, and fits a telephone."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Iterable
from html import escape

import numpy as np

from hodge_pipeline.evaluation.difference import percent
from hodge_pipeline.report.contents import Photograph, Report
from hodge_pipeline.report.plots import Plot
from hodge_pipeline.report.tables import (
    Table,
    graph_tables,
    score_tables,
    source_table,
    stages_table,
    worst_edges_table,
)
from hodge_pipeline.report.verdict import Outcome, judge, suspicions

NARROW = "\u202f"
SYMBOLS: dict[Outcome, str] = {"improved": "▲", "unchanged": "＝", "worse": "▼", "mixed": "◆", "not measured": "?"}

STYLE = """
:root { --ink: #1a1a1a; --soft: #595959; --line: #d9d9d9; --paper: #fff; --shade: #f5f6f8; }
* { box-sizing: border-box; }
body { margin: 0 auto; padding: 1.5rem 1.2rem 3rem; max-width: 66rem; color: var(--ink); background: var(--paper);
  font: 16px/1.5 system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", sans-serif; }
h1 { margin: 0 0 .2rem; font-size: 1.7rem; line-height: 1.2; overflow-wrap: anywhere; }
h2 { margin: 2rem 0 .4rem; font-size: 1.2rem; }
p { margin: .3rem 0 .8rem; }
.soft, figcaption, .caption { color: var(--soft); font-size: .88rem; }
.verdict { margin: 1rem 0; padding: .8rem 1rem; border-left: .5rem solid; background: var(--shade); }
.verdict b { font-size: 1.15rem; }
.improved { border-color: #0072b2; } .worse { border-color: #d55e00; } .mixed { border-color: #e69f00; }
.unchanged, .not-measured { border-color: #7f7f7f; }
.tiles { display: grid; gap: .7rem; padding: 0; margin: 1rem 0;
  grid-template-columns: repeat(auto-fit, minmax(9.5rem, 1fr)); }
.tiles li { list-style: none; padding: .6rem .8rem; border: 1px solid var(--line); border-radius: .4rem; }
.tiles strong { display: block; font-size: 1.2rem; font-variant-numeric: tabular-nums; }
.tiles span { color: var(--soft); font-size: .82rem; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; width: 100%; font-size: .92rem; font-variant-numeric: tabular-nums; }
th, td { padding: .3rem .6rem; border-bottom: 1px solid var(--line); text-align: right; white-space: nowrap; }
th { font-weight: 600; color: var(--soft); border-bottom-width: 2px; white-space: normal;
  vertical-align: bottom; min-width: 3.8rem; }
.word { text-align: left; white-space: normal; overflow-wrap: break-word; min-width: 5.5rem; }
tr.after td { font-weight: 600; background: var(--shade); }
ul.notes { padding-left: 1.2rem; } ul.notes li { margin: .2rem 0; }
.plots { display: grid; gap: 1.2rem; grid-template-columns: repeat(auto-fit, minmax(min(100%, 26rem), 1fr)); }
figure { margin: 0; } figure img { width: 100%; height: auto; } figure h3 { margin: 0; font-size: 1rem; }
pre { padding: .8rem; background: var(--shade); font-size: .82rem; white-space: pre-wrap; overflow-wrap: anywhere; }
details { margin-top: 1.5rem; } summary { cursor: pointer; font-size: 1.2rem; font-weight: 600; }
@media print { body { max-width: none; padding: 0; font-size: 11px; } section, figure, tr { break-inside: avoid; }
  .verdict, .tiles li, tr.after td { print-color-adjust: exact; } .scroll { overflow: visible; } }
"""


def render(report: Report, drawn: Iterable[Plot]) -> str:
    """The page, as HTML5 text."""
    first_page = [_head(report), _verdict(report), _tiles(report), _notes(report)]
    tables = [*score_tables(report), *([worst_edges_table(report)] if report.worst_edges else [])]
    details = [source_table(report), *graph_tables(report), *([stages_table(report)] if report.stages else [])]
    body = [
        *first_page,
        photographs(
            "The scene from four sides",
            f"The frames' clouds laid together by their poses: {report.before} on the left, {report.after} on "
            "the right. Walls that are double on the left and single on the right are what the run is for.",
            report.pictures.sides,
        ),
        *(table(each, report.after) for each in tables),
        photographs("Frames of the worst edges", "", report.pictures.worst_pairs),
        plots(drawn),
        *(table(each, report.after) for each in details),
        _versions(report),
        _recipe(report),
    ]
    return document(report.title, body)


def document(title: str, body: Iterable[str]) -> str:
    """A whole page of these parts, in the style of all pages."""
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n<style>{STYLE}</style>\n</head>\n<body>\n"
        + "\n".join(part for part in body if part)
        + "\n</body>\n</html>\n"
    )


def _head(report: Report) -> str:
    source = report.source
    sequences = f" in {len(source.sequences)} sequences" if len(source.sequences) > 1 else ""
    truth = (
        f"{source.frames_with_truth} with a true pose" if source.frames_with_truth else "no true poses to compare with"
    )
    return (
        f"<header><h1>{escape(report.title)}</h1>"
        f'<p class="soft">{escape(source.name)}: {source.counted}{sequences}, {truth}. '
        f"The poses of the frames were made globally consistent; this page says whether that helped.</p></header>"
    )


def _verdict(report: Report) -> str:
    verdict = judge(report)
    kind, symbol = verdict.mark.replace(" ", "-"), SYMBOLS[verdict.mark]
    return (
        f'<div class="verdict {kind}"><b>{symbol} {escape(verdict.headline)}</b>'
        f"<br>{escape(verdict.details[:1].upper() + verdict.details[1:])}</div>"
    )


def _tiles(report: Report) -> str:
    tiles = [
        (
            " → ".join(each.replace(" ", NARROW) for each in change.values),
            change.what.removeprefix("the ") + ("" if np.isnan(change.share) else f", {percent(change.share)}"),
        )
        for change in judge(report).changes
    ]
    if report.graph is not None:
        parts = len(report.graph.components)
        tiles.append(
            (
                f"{report.graph.edges} edges",
                f"{report.graph.vertices} {report.source.vertex_name}, {_plural(parts, 'connected part')}",
            )
        )
    if report.stages:
        seconds = sum(stage.wall_s for stage in report.stages)
        peak = max(stage.peak_mb for stage in report.stages)
        tiles.append((_duration(seconds), f"in all; at most {peak:.0f} MB"))
    items = "".join(
        f"<li><strong>{escape(big)}</strong><span>{escape(small.replace(' %', NARROW + '%'))}</span></li>"
        for big, small in tiles
    )
    return f'<ul class="tiles">{items}</ul>' if tiles else ""


def _plural(count: int, noun: str) -> str:
    return f"{count} {noun}" + ("" if count == 1 else "s")


def _duration(seconds: float) -> str:
    if seconds < 120:
        return f"{seconds:.1f} s"
    return f"{seconds / 60:.1f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"


def _notes(report: Report) -> str:
    lines = suspicions(report)
    if not lines:
        return "<section><h2>What to look at</h2><p>Nothing suspicious was found.</p></section>"
    items = "".join(f"<li>{escape(str(line))}</li>" for line in lines)
    return f'<section><h2>What to look at</h2><ul class="notes">{items}</ul></section>'


def table(shown: Table, highlighted: str) -> str:
    """A table with its title and caption; the row that begins with `highlighted` stands out."""
    head = "".join(f"<th{_word(column, shown)}>{escape(name)}</th>" for column, name in enumerate(shown.header))
    rows = "".join(_row(row, shown, highlighted) for row in shown.rows)
    caption = f'<p class="caption">{escape(shown.caption)}</p>' if shown.caption else ""
    return (
        f'<section><h2>{escape(shown.title)}</h2>{caption}<div class="scroll"><table><thead><tr>{head}</tr></thead>'
        f"<tbody>{rows}</tbody></table></div></section>"
    )


def _row(row: tuple[str, ...], table: Table, highlighted: str) -> str:
    cells = "".join(f"<td{_word(column, table)}>{escape(cell)}</td>" for column, cell in enumerate(row))
    return f'<tr class="after">{cells}</tr>' if row[0] == highlighted else f"<tr>{cells}</tr>"


def _word(column: int, table: Table) -> str:
    return ' class="word"' if column < table.names else ""


def plots(drawn: Iterable[Plot]) -> str:
    """The plots side by side where there is room."""
    figures = "".join(
        f'<figure><h3>{escape(plot.title)}</h3><img alt="{escape(plot.title)}. {escape(plot.caption)}" '
        f'src="data:image/png;base64,{b64encode(plot.png).decode()}"><figcaption>{escape(plot.caption)}</figcaption></figure>'
        for plot in drawn
    )
    return f'<section class="pictures"><h2>Pictures</h2><div class="plots">{figures}</div></section>' if figures else ""


def photographs(title: str, caption: str, shown: Iterable[Photograph]) -> str:
    """Photographs side by side where there is room, nothing where there are none."""
    figures = "".join(
        f'<figure><h3>{escape(each.title)}</h3><img alt="{escape(each.title)}. {escape(each.caption)}" '
        f'src="data:image/jpeg;base64,{b64encode(each.jpeg).decode()}"><figcaption>{escape(each.caption)}</figcaption></figure>'
        for each in shown
    )
    text = f'<p class="caption">{escape(caption)}</p>' if caption else ""
    return (
        f'<section class="pictures"><h2>{escape(title)}</h2>{text}<div class="plots">{figures}</div></section>'
        if figures
        else ""
    )


def _versions(report: Report) -> str:
    if not report.versions:
        return ""
    words = ", ".join(f"{name} {version}" for name, version in report.versions.items())
    return f'<section><h2>Versions</h2><p class="soft">{escape(words)}</p></section>'


def _recipe(report: Report) -> str:
    if not report.recipe:
        return ""
    return f"<details open><summary>Recipe</summary><pre>{escape(report.recipe)}</pre></details>"
