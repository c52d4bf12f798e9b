"""The pictures of a report, as PNG. Colours are Okabe and Ito's, and no curve is told apart by its colour alone."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.ticker import LogFormatter

from hodge_pipeline.report.contents import Report
from hodge_pipeline.report.document import Picture
from hodge_pipeline.report.error_plots import error_plots, has_truth
from hodge_pipeline.report.painting import flattest_plane, map_axes, matrix_axes, painted
from hodge_pipeline.report.tables import counted_pairs
from hodge_pipeline.types import Floats, Ints
from hodge_pipeline.types.text import UNKNOWN_UNIT

STYLES: tuple[dict[str, Any], ...] = (
    {"color": "#000000", "linestyle": (0, (4, 2)), "linewidth": 1.2},
    {"color": "#D55E00", "linestyle": (0, (1, 1)), "linewidth": 1.6},
    {"color": "#0072B2", "linestyle": "-", "linewidth": 1.6},
    {"color": "#009E73", "linestyle": (0, (6, 1, 1, 1)), "linewidth": 1.4},
    {"color": "#CC79A7", "linestyle": (0, (8, 2)), "linewidth": 1.4},
    {"color": "#56B4E9", "linestyle": (0, (2, 2)), "linewidth": 1.4},
)
MARKERS = "osD^vP"
HISTOGRAM_BINS = 40
WIDE = 5
"""Values that differ by less than this factor are legible on a linear axis."""
LEAST_DOT_M = 1e-3
"""Edges that fit better all have the first colour."""
SMALLEST_RESIDUAL = 1e-3
"""Where a logarithmic histogram begins, in centimetres and degrees: nothing below it is of interest."""


class PlainNumbers(LogFormatter):
    """Writes 0.1 and 40 on a logarithmic axis, where Matplotlib has powers of ten."""

    def __call__(self, x: float, pos: int | None = None) -> str:
        """The number at x; nothing where the ticks would be too many."""
        return f"{x:g}" if super().__call__(x, pos) else ""


def draw_convergence(report: Report) -> tuple[Picture, ...]:
    """How the solver came to its result."""
    if not any(report.pictures.convergence.values()) and not report.loops:
        return ()
    loops = ", and mean deviation of a loop" if report.loops else ""
    caption = f"Objective of the solver{loops}, by iteration. It may rise where a solver weighs edges anew."
    return (painted("Convergence", caption, lambda figure: _convergence(figure, report)),)


def draw(report: Report) -> Iterator[Picture]:
    """Every plot that the report has data for, but those of convergence."""
    pictures = report.pictures
    if any(np.isfinite(path.positions).any() for path in pictures.paths):
        caption = f"Seen across its flattest direction{', aligned to the truth' if has_truth(report) else ''}."
        yield painted("Trajectory from above", caption, lambda figure: _paths(figure, report))
    yield from error_plots(report)
    if report.scores is not None and any(len(graph.pairs) for graph in report.scores.graphs):
        yield painted(
            "Score of each pair",
            "How well the two clouds of a pair fit: further right is better, 1 is perfect (Scores).",
            lambda figure: _score_histogram(figure, report),
        )
    if any(len(residuals.translation_m) for residuals in pictures.residuals):
        least = f"what is below {SMALLEST_RESIDUAL} is drawn as that"
        caption = f"Measured motions against the poses: further left is better; {least}."
        yield painted("Residual of each edge", caption, lambda figure: _residuals(figure, report))
    if pictures.graph is not None and pictures.graph.edge_count:
        caption = "Above the diagonal: where each edge comes from. Below: how far it is off the result."
        yield painted("Viewing graph", caption, lambda figure: _matrix(figure, report))


def _style(report: Report, name: str) -> dict[str, Any]:
    """The same line for a set of poses in every plot: the reference dashed, before dotted, after solid."""
    fixed = {report.before: 1, report.after: 2}
    if name in fixed:
        return STYLES[fixed[name]]
    scored = () if report.scores is None else report.scores.names
    names = dict.fromkeys((*(path.name for path in report.pictures.paths), *scored))
    others = [other for other in names if other not in fixed]
    free = (0, 3, 4, 5)
    return STYLES[free[others.index(name) % len(free)]] if name in others else STYLES[0]


def _paths(figure: Figure, report: Report) -> None:
    axes = figure.add_subplot()
    paths, component = report.pictures.paths, report.pictures.component
    origin, plane = flattest_plane(paths[0].positions)
    for path in paths:
        along, across = plane @ (_broken(path.positions, component) - origin).T
        axes.plot(along, across, label=path.name, **_style(report, path.name))
    map_axes(axes, report)
    axes.legend(frameon=False, fontsize=9)


def _broken(positions: Floats, component: Ints) -> Floats:
    """The path with a gap wherever the component changes."""
    cuts = np.flatnonzero(np.diff(component)) + 1 if len(component) == len(positions) else np.zeros(0, np.int64)
    return np.asarray(np.insert(positions, cuts, np.nan, axis=0))


def _score_histogram(figure: Figure, report: Report) -> None:
    table = report.scores
    assert table is not None
    graph = max(table.graphs, key=lambda graph: len(graph.pairs))
    axes = figure.add_subplot()
    known = graph.scores[np.isfinite(graph.scores)]
    lowest = min(float(np.quantile(known, 0.002)), 0.9) if len(known) else 0.0
    bins = np.linspace(lowest, 1.0, HISTOGRAM_BINS).tolist()
    for row, name in enumerate(table.names):
        scores = graph.scores[row][np.isfinite(graph.scores[row])]
        mean = f", mean {scores.mean():.3f}" if len(scores) else ", not scored"
        axes.hist(scores, bins=bins, histtype="step", label=f"{name}{mean}", **_style(report, name))
    axes.set_xlabel(f"score, {counted_pairs(graph)}")
    _count(axes, "pairs")
    _legend_above(axes)


def _residuals(figure: Figure, report: Report) -> None:
    unit, factor = _small_unit(report)
    for axes, name, name_unit, columns in zip(
        figure.subplots(2, 1),
        ("translation", "rotation"),
        (f" {unit}", "°"),
        (
            [(r.name, r.translation_m * factor) for r in report.pictures.residuals],
            [(r.name, np.rad2deg(r.angle_rad)) for r in report.pictures.residuals],
        ),
        strict=True,
    ):
        _log_histogram(axes, report, columns, name_unit)
        axes.set_xlabel(f"residual {name}, {name_unit.strip()}")
        _count(axes, "edges")
        _legend_above(axes)


def _legend_above(axes: Any) -> None:
    """A legend that hides no bar."""
    axes.legend(frameon=False, fontsize=8, loc="lower right", bbox_to_anchor=(1, 1), ncols=2, borderaxespad=0)


def _small_unit(report: Report) -> tuple[str, float]:
    """The unit of residuals, and how many of them a metre has."""
    return ("cm", 100.0) if report.has_metres else (UNKNOWN_UNIT, 1.0)


def _log_histogram(axes: Any, report: Report, columns: list[tuple[str, Floats]], unit: str) -> None:
    known = [(name, values[np.isfinite(values)]) for name, values in columns]
    every = np.concatenate([values for _, values in known if len(values)] or [np.zeros(1)]).clip(SMALLEST_RESIDUAL)
    low, high = np.floor(np.log10(every.min())), np.ceil(np.log10(1.001 * every.max()))
    bins = np.geomspace(10**low, 10**high, HISTOGRAM_BINS)
    for name, values in known:
        median = f", median {np.median(values):.2g}{unit}" if len(values) else ""
        shown = values.clip(SMALLEST_RESIDUAL)
        axes.hist(shown, bins=bins, histtype="step", label=f"{name}{median}", **_style(report, name))
    axes.set_xscale("log")
    _write_plainly(axes.xaxis)


def _write_plainly(axis: Any) -> None:
    axis.set_major_formatter(PlainNumbers())
    axis.set_minor_formatter(PlainNumbers())


def _count(axes: Any, what: str) -> None:
    """How many, in whole numbers, upwards."""
    axes.set_ylabel(what)
    axes.yaxis.get_major_locator().set_params(integer=True)


def _matrix(figure: Figure, report: Report) -> None:
    graph = report.pictures.graph
    assert graph is not None
    axes, low, high, size = matrix_axes(figure, graph, report.source.vertex, 0.3)
    for rank, name in enumerate(np.unique(graph.source)):
        rows = graph.source == name
        colour = STYLES[(2, 1, 3, 4, 5, 0)[rank % 6]]["color"]
        marker = MARKERS[rank % len(MARKERS)]
        axes.scatter(high[rows], low[rows], s=size, color=colour, marker=marker, linewidths=0, label=str(name))
    _residual_dots(figure, axes, report, low, high, size)
    figure.legend(
        *axes.get_legend_handles_labels(),
        frameon=False,
        fontsize=8,
        markerscale=(16 / size) ** 0.5,
        loc="outside upper center",
        ncols=3,
    )


def _residual_dots(figure: Figure, axes: Any, report: Report, low: Ints, high: Ints, size: float) -> None:
    after = [residuals for residuals in report.pictures.residuals if residuals.name == report.after]
    if not after:
        return
    order = np.argsort(after[0].translation_m)
    unit, factor = _small_unit(report)
    least = LEAST_DOT_M * factor
    sizes = np.maximum(after[0].translation_m[order] * factor, least)
    top = float(np.nanmax(sizes, initial=10 * least))
    dots = axes.scatter(
        low[order], high[order], s=size, c=sizes, cmap="cividis_r", norm=LogNorm(least, top), linewidths=0
    )
    _write_plainly(figure.colorbar(dots, ax=axes, label=f"residual, {unit}", shrink=0.8).ax.yaxis)


def _convergence(figure: Figure, report: Report) -> None:
    series = {name: values for name, values in report.pictures.convergence.items() if values}
    panels = figure.subplots(1 + bool(series and report.loops), 1, squeeze=False)[:, 0]
    if series:
        for rank, (name, values) in enumerate(series.items()):
            axes_style = {**STYLES[(2, 1, 3, 4, 5, 0)[rank % 6]], "marker": MARKERS[rank % 6], "markersize": 4}
            panels[0].plot(range(len(values)), values, label=name, **axes_style)
        _log_where_positive(panels[0], [value for values in series.values() for value in values])
        panels[0].set_ylabel("objective")
        panels[0].legend(frameon=False, fontsize=8)
    if report.loops:
        means = [row.mean for row in report.loops]
        panels[-1].plot(range(len(means)), means, marker="o", markersize=4, **STYLES[2])
        _log_where_positive(panels[-1], means)
        panels[-1].set_ylabel("mean D of a loop")
    panels[-1].set_xlabel("iteration")


def _log_where_positive(axes: Any, values: list[float]) -> None:
    if values and 0 < WIDE * min(values) < max(values):
        axes.set_yscale("log")
        _write_plainly(axes.yaxis)
    axes.xaxis.get_major_locator().set_params(integer=True)
