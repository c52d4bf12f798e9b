"""How plots are painted: figures, and axes of maps and of graphs."""

from __future__ import annotations

import io
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from hodge_pipeline.report.contents import Report
from hodge_pipeline.report.document import Picture
from hodge_pipeline.types import Floats, Ints, ViewGraph
from hodge_pipeline.types.text import UNKNOWN_UNIT

if TYPE_CHECKING:
    from matplotlib.figure import Figure

DOTS_PER_INCH = 150
SIZE = 5.0, 3.9
"""Inches."""
MOST_TICKS = 6
"""Along an axis of a map: the labels of a map of millimetres are long."""


def painted(title: str, caption: str, paint: Callable[[Figure], None]) -> Picture:
    """A painted figure as a picture."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=SIZE, dpi=DOTS_PER_INCH, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    paint(figure)
    for axes in figure.axes:
        axes.grid(alpha=0.25, linewidth=0.5)
        axes.set_axisbelow(True)
        axes.spines[["top", "right"]].set_visible(False)
    target = io.BytesIO()
    # savefig would lay out and draw it all twice
    canvas.print_png(target, metadata={"Software": None})  # type: ignore[no-untyped-call]
    return Picture(title, caption, target.getvalue())


def map_axes(axes: Any, report: Report) -> None:
    """Axes of a map: a metre is as long along both."""
    axes.set_aspect("equal", adjustable="datalim")
    unit = "m" if report.has_metres else UNKNOWN_UNIT
    axes.set(xlabel=unit, ylabel=unit)
    axes.locator_params(nbins=MOST_TICKS)


def matrix_axes(figure: Figure, graph: ViewGraph, vertex: str, least: float) -> tuple[Any, Ints, Ints, float]:
    """Axes of a viewing graph's matrix; the lower and higher vertex row (E,) of each edge; the size of a dot, `least`
    in a large graph.
    """
    axes: Any = figure.add_subplot()
    axes.set_xlim(-0.5, graph.vertex_count - 0.5)
    axes.set_ylim(graph.vertex_count - 0.5, -0.5)
    axes.set_aspect("equal")
    axes.set_xlabel(f"{vertex} (row)")
    size = float(np.clip(60_000 / graph.vertex_count**2, least, 30))
    return axes, graph.edges.min(axis=1), graph.edges.max(axis=1), size


def flattest_plane(positions: Floats) -> tuple[Floats, Floats]:
    """The mean of positions (N, 3), and the two directions (2, 3) along which they spread most."""
    known = positions[np.isfinite(positions).all(axis=1)]
    if not len(known):
        return np.zeros(3), np.eye(3)[:2]
    origin = known.mean(axis=0)
    spread = (known - origin).T @ (known - origin)
    return origin, np.linalg.eigh(spread)[1][:, :0:-1].T
