"""Plots of the errors along the path: over time, per axis, and as its colour."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.evaluation.difference import floor_of
from hodge_pipeline.report.contents import TRUTH, Report
from hodge_pipeline.report.document import Picture
from hodge_pipeline.report.painting import flattest_plane, map_axes, painted
from hodge_pipeline.types import Floats
from hodge_pipeline.types.text import UNKNOWN_UNIT

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LINES = (":", "#D55E00"), ("-", "#0072B2")
"""Before and after, as in every plot."""


def error_plots(report: Report) -> Iterator[Picture]:
    """The errors along the path against the truth; without one, how far the run moved each frame."""
    errors = offsets(report)
    if not errors:
        return
    against = "from the truth, aligned" if has_truth(report) else f"from where it lay in the {report.before} poses"
    title = "Error" if has_truth(report) else "Movement"
    yield painted(
        f"{title} over time, per axis",
        f"How far each frame lies {against}; below, by how much it is turned, but for the mean turn.",
        lambda figure: _over_time(figure, report),
    )
    last = report.after if report.after in errors else next(iter(errors))
    yield painted(
        f"{title} along the path", f"{last}: the colour says how far each frame lies {against}.",
        lambda figure: _coloured_path(figure, report, last),
    )  # fmt: skip


def has_truth(report: Report) -> bool:
    """Whether the positions can be compared with true ones."""
    return any(path.name == TRUTH for path in report.pictures.paths)


def offsets(report: Report) -> dict[str, Floats]:
    """Offsets (N, 3) of each set of positions from the truth or, without one, of the result from those before;
    empty where the result did not move.
    """
    paths = {path.name: path.positions for path in report.pictures.paths}
    if not paths.keys() >= {report.before, report.after}:
        return {}
    shown = {name: paths[name] for name in (report.before, report.after)}
    if TRUTH not in paths:
        shown = {report.after: shown[report.after]}
        moved_m = np.linalg.norm(paths[report.after] - paths[report.before], axis=1)
        if not (moved_m > floor_of(*paths.values())).any():
            return {}
    found = {name: positions - paths.get(TRUTH, paths[report.before]) for name, positions in shown.items()}
    return found if all(np.isfinite(each).any() for each in found.values()) else {}


def turns_deg(report: Report) -> dict[str, Floats]:
    """Angle in degrees (N,) of each set of poses against the reference of `offsets`, after the mean rotation of each
    component, which an alignment of positions along a line leaves open.
    """
    rotations = {path.name: path.rotations for path in report.pictures.paths}
    reference = rotations.get(TRUTH if has_truth(report) else report.before)
    found = {}
    for name in offsets(report):
        own = rotations[name]
        if own is None or reference is None:
            continue
        component = report.pictures.component if len(report.pictures.component) == len(own) else np.zeros(len(own), int)
        known = se3.has_pose(own) & se3.has_pose(reference)
        found[name] = np.full(len(own), np.nan)
        for part in np.unique(component[known]):
            rows = np.flatnonzero(known & (component == part))
            turn = se3.project_to_so3((reference[rows] @ np.swapaxes(own[rows], 1, 2)).mean(axis=0))
            apart = np.swapaxes(reference[rows], 1, 2) @ turn @ own[rows]
            found[name][rows] = np.degrees(np.linalg.norm(se3.so3_log(apart), axis=-1))
    return found


def _unit(report: Report, offsets: Sequence[Floats]) -> tuple[str, float]:
    """The unit that suits these offsets, and how many of them a metre has."""
    if not report.has_metres:
        return UNKNOWN_UNIT, 1.0
    largest = max(float(np.nanmax(np.abs(each), initial=0.0)) for each in offsets)
    return ("mm", 1000.0) if largest < 0.02 else ("cm", 100.0) if largest < 1 else ("m", 1.0)


def _over_time(figure: Figure, report: Report) -> None:
    errors = offsets(report)
    unit, factor = _unit(report, list(errors.values()))
    times, label = _times(report, len(next(iter(errors.values()))))
    curves = {
        f"{name}, {unit}": {poses: each[:, axis] * factor for poses, each in errors.items()}
        for axis, name in enumerate("xyz")
    }
    turns = turns_deg(report)
    if turns:
        curves["rotation, °"] = turns
    panels = figure.subplots(len(curves), 1, sharex=True)
    for axes, (title, series) in zip(panels, curves.items(), strict=True):
        for (line, colour), (poses, values) in zip(LINES[-len(series) :], series.items(), strict=True):
            axes.plot(times, values, linewidth=1.1, label=poses, linestyle=line, color=colour)
        axes.set_ylabel(title, fontsize=8)
    panels[-1].set_xlabel(label)
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside upper right", ncols=2, frameon=False, fontsize=8)


def _times(report: Report, count: int) -> tuple[Floats, str]:
    stamps = report.pictures.stamps_s
    if len(stamps) == count and count > 1 and (np.diff(stamps) > 0).all():
        return stamps - stamps[0], "s"
    return np.arange(count, dtype=float), f"{report.source.vertex} (row)"


def _coloured_path(figure: Figure, report: Report, name: str) -> None:
    positions = next(path.positions for path in report.pictures.paths if path.name == name)
    size = np.linalg.norm(offsets(report)[name], axis=1)
    unit, factor = _unit(report, [size])
    origin, plane = flattest_plane(positions)
    along, across = plane @ (positions - origin).T
    axes = figure.add_subplot()
    axes.plot(along, across, color="#bbbbbb", linewidth=0.6, zorder=0)
    worst_last = np.argsort(np.nan_to_num(size, nan=-1.0), kind="stable")
    dots = axes.scatter(
        along[worst_last], across[worst_last], c=size[worst_last] * factor, s=14, cmap="viridis_r", linewidths=0
    )
    figure.colorbar(dots, ax=axes, label=unit, shrink=0.8)
    map_axes(axes, report)
