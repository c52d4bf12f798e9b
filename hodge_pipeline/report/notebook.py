"""A report in a notebook's cell: the verdict, the place that changed most, the tables of errors."""

from __future__ import annotations

from collections.abc import Iterator

from markupsafe import Markup

from hodge_pipeline.report.contents import Report
from hodge_pipeline.report.document import Table
from hodge_pipeline.report.tables import score_tables
from hodge_pipeline.report.verdict import judge


def as_html(report: Report) -> str:
    """A fragment of HTML; whatever the data says is escaped."""
    return Markup("\n").join(_parts(report))


def _parts(report: Report) -> Iterator[Markup]:
    verdict = judge(report)
    yield Markup("<b>{}</b>").format(verdict.headline)
    yield _list(verdict.points)
    for picture in (*report.pictures.changed_most, *report.pictures.sides)[:1]:
        yield Markup('<img style="max-width:100%" alt="{}" src="{}">').format(picture.caption, picture.address)
    yield from map(_table, score_tables(report))


def _list(lines: tuple[str, ...]) -> Markup:
    return Markup("<ul>{}</ul>").format(Markup("").join(Markup("<li>{}</li>").format(line) for line in lines))


def _table(table: Table) -> Markup:
    rows = [_row("th", table.header), *(_row("td", row) for row in table.rows)]
    return Markup("<table><caption>{}</caption>{}</table>").format(table.title, Markup("").join(rows))


def _row(kind: str, cells: tuple[str, ...]) -> Markup:
    tag = Markup(kind)
    return Markup("<tr>{}</tr>").format(Markup("").join(Markup("<{0}>{1}</{0}>").format(tag, cell) for cell in cells))
