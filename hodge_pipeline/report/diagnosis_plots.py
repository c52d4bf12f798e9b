"""The pictures of a diagnosis that need no images: the viewing graph by verdict, the cameras from above, energy."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from matplotlib.collections import PathCollection
from matplotlib.figure import Figure

from hodge_pipeline.complex.components import apart_along_x
from hodge_pipeline.diagnosis.result import CONSISTENT, SUSPECT, UNTESTABLE, WRONG, Diagnosis
from hodge_pipeline.recording.shapes import VERDICT_COLOURS
from hodge_pipeline.report.document import Picture
from hodge_pipeline.report.energy import PARTS, EnergyRow
from hodge_pipeline.report.painting import flattest_plane, matrix_axes, painted
from hodge_pipeline.types import Floats, Ints, ViewGraph
from hodge_pipeline.types.text import UNKNOWN_UNIT

COLOURS = {verdict: "#" + bytes(colour).hex() for verdict, colour in VERDICT_COLOURS.items()}
"""As in the recording; markers tell them apart without colour."""
MARKERS = {CONSISTENT: "s", UNTESTABLE: "D", SUSPECT: "^", WRONG: "X"}
PART_COLOURS = ("#56b4e9", "#e69f00", "#444444")
GAP_SHARE = 0.25
FEW = 15
"""Gap between pieces, as a share of the largest; and how many edges are still drawn large, each apart from the next."""


def draw(graph: ViewGraph, diagnosis: Diagnosis, energy: Sequence[EnergyRow], has_metres: bool) -> Iterator[Picture]:
    """Every picture that there are data for."""
    if graph.edge_count:
        yield painted(
            "Viewing graph by verdict",
            "A dot is an edge between the frames of its row and column. Above the diagonal: its verdict. Below: the "
            "probability that it is right; untestable edges have none.",
            lambda figure: _matrix(figure, graph, diagnosis),
        )
        yield painted(
            "Edges from above",
            "The frames at their robust poses, seen across their flattest direction, with the edges by verdict; pieces "
            "that nothing sound connects are drawn beside each other.",
            lambda figure: _above(figure, graph, diagnosis, "m" if has_metres else UNKNOWN_UNIT),
        )
    if energy:
        yield painted(
            "Energy of the residual motions",
            "Rotation left, translation right. Exact: what moving frames would take away. Co-exact: seen in triangles. "
            "Harmonic: around loops that no triangles fill.",
            lambda figure: _bars(figure, energy),
        )


def _matrix(figure: Figure, graph: ViewGraph, diagnosis: Diagnosis) -> None:
    axes, low, high, size = matrix_axes(figure, graph, "frame", 0.5)
    for name in (CONSISTENT, UNTESTABLE, SUSPECT, WRONG):
        rows = np.flatnonzero(diagnosis.verdict == name)
        larger = size if name == CONSISTENT else size * (1 + 2 * _rarity(len(rows)))
        label = f"{len(rows)} {name}"
        axes.scatter(high[rows], low[rows], s=larger, c=COLOURS[name], marker=MARKERS[name], linewidths=0, label=label)
    known = np.flatnonzero(np.isfinite(diagnosis.probability))
    order = known[np.argsort(-diagnosis.probability[known], kind="stable")]
    dots = axes.scatter(
        low[order], high[order], s=size, c=diagnosis.probability[order], cmap="cividis", vmin=0, vmax=1, linewidths=0
    )
    figure.colorbar(dots, ax=axes, label="probability of being right", shrink=0.8)
    _legend(figure, axes)


def _legend(figure: Figure, axes: Any) -> None:
    drawn, labels = axes.get_legend_handles_labels()
    legend = figure.legend(drawn, labels, loc="outside upper center", ncols=4, frameon=False, fontsize=8)
    for handle in legend.legend_handles:
        if isinstance(handle, PathCollection):
            handle.set_sizes([25.0])


def _above(figure: Figure, graph: ViewGraph, diagnosis: Diagnosis, unit: str) -> None:
    axes = figure.add_subplot()
    positions = pieces_apart(diagnosis.world_from_cam, diagnosis.piece)[:, :3, 3]
    origin, plane = flattest_plane(positions)
    places = (positions - origin) @ plane.T
    for name in (CONSISTENT, UNTESTABLE, SUSPECT, WRONG):
        rows = np.flatnonzero(diagnosis.verdict == name)
        thick = 0.4 if name == CONSISTENT else 0.4 + 1.2 * _rarity(len(rows))
        style = {CONSISTENT: "-", UNTESTABLE: ":", SUSPECT: "--", WRONG: "-"}[name]
        # one line with gaps: a path for each of 100,000 edges would take seconds
        ends = np.concatenate([places[graph.edges[rows]], np.full((len(rows), 1, 2), np.nan)], axis=1).reshape(-1, 2)
        axes.plot(ends[:, 0], ends[:, 1], style, color=COLOURS[name], linewidth=thick, label=name)
    axes.scatter(places[:, 0], places[:, 1], s=4, c="#222222", linewidths=0, zorder=3)
    axes.set_aspect("equal", adjustable="datalim")
    axes.autoscale_view()
    axes.set_xlabel(unit)
    _legend(figure, axes)


def _rarity(count: int) -> float:
    """1 for a few edges, towards 0 for very many: what is rare is drawn large."""
    return min(1.0, FEW / max(count, 1))


def pieces_apart(world_from_cam: Floats, piece: Ints) -> Floats:
    """The poses (V, 4, 4) with the components moved apart along x for a drawing; the largest stays."""
    first = world_from_cam[piece == 0, :3, 3]
    gap = max(GAP_SHARE * float(np.ptp(first, axis=0).max()), 0.1) if len(first) else 0.1
    return apart_along_x(world_from_cam, piece, gap)


def _bars(figure: Figure, rows: Sequence[EnergyRow]) -> None:
    for axes, kind in zip(figure.subplots(1, 2, sharey=True), ("rotation", "translation"), strict=True):
        left = np.zeros(len(rows))
        for part, name, colour, hatch in zip(range(3), PARTS, PART_COLOURS, ("", "//", ".."), strict=True):
            shares = np.array([100 * row.kinds[kind][1][part] for row in rows])
            axes.barh(
                [row.when for row in rows], shares, left=left, color=colour, hatch=hatch, edgecolor="white", label=name
            )
            left += shares
        axes.set_title(kind, fontsize=9)
        axes.set_xlabel("%")
    axes.invert_yaxis()
    figure.legend(*axes.get_legend_handles_labels(), loc="outside upper center", ncols=3, frameon=False, fontsize=8)
