"""Log registrations: statistics of all pairs, and clouds of chosen pairs before and after."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from hodge_pipeline import se3
from hodge_pipeline.recording import layout
from hodge_pipeline.recording.stream import Part, log_markdown
from hodge_pipeline.types import CloudSet, Edges, Floats, Floats32
from hodge_pipeline.types.arrays import evenly
from hodge_pipeline.types.edges import REJECTED
from hodge_pipeline.types.text import markdown_table

POINTS_SHOWN = 6_000
TARGET_COLOUR, BEFORE_COLOUR, AFTER_COLOUR = (86, 180, 233), (230, 130, 0), (240, 228, 66)
"""Blue, orange and yellow of Okabe and Ito's set."""
BINS = 30
"""Of a histogram: the square root of a thousand pairs."""
POINT_RADIUS = -1.0
"""Negative, as all radii here: in pixels of the view, whatever the scene measures."""


def log_registration(part: Part, outer: int, registered: Edges, guesses: Floats, clouds: CloudSet) -> None:
    """Log histograms and columns of all pairs (P,), and the clouds of chosen ones in i's axes.

    `guesses (P, 4, 4)` is `i_from_j` as registration began.
    """
    stream = part.stream
    log_columns(stream, outer, registered)
    for name, values in (("fitness", registered.fitness), ("rmse_mm", registered.rmse_m * 1000)):
        _log_histogram(stream, layout.under(layout.BARS, f"{name}_round_{outer}"), values)
    if part.options.has_images:
        chosen = chosen_pairs(registered, guesses)
        for name, row in chosen.items():
            _log_pair(stream, name, registered, row, guesses, clouds)
            axes = rr.ViewCoordinates.FLU if part.is_scanner else rr.ViewCoordinates.RDF
            stream.log(layout.pair(name), axes, static=True)
        log_markdown(stream, layout.PAIRS_TEXT, _text(registered, guesses, chosen))


def log_columns(stream: rr.RecordingStream, outer: int, registered: Edges) -> None:
    """Every pair's numbers, one row each, as components that a program reads back."""
    if not len(registered.pairs):
        return
    stream.log(
        layout.registration(outer),
        rr.AnyValues(
            i=registered.pairs[:, 0],
            j=registered.pairs[:, 1],
            fitness=registered.fitness.astype(np.float32),
            rmse_m=registered.rmse_m.astype(np.float32),
            iterations=registered.iterations,
            correspondences=registered.correspondences,
            rejected=_reasons(registered).tolist(),
        ),
        static=True,
    )


def _reasons(registered: Edges) -> NDArray[np.str_]:
    """Why each pair (P,) was rejected; empty for an edge, where `why` is what the diagnosis says."""
    return np.where(registered.status == REJECTED, registered.why, "")


def chosen_pairs(registered: Edges, guesses: Floats) -> Mapping[str, int]:
    """Rows by name: the edge that registration moved most, the edge of least fitness, the fittest pair rejected."""
    edges, others = np.flatnonzero(registered.counts), np.flatnonzero(~registered.counts)
    found: dict[str, int] = {}
    if len(edges):
        found["moved_most"] = int(edges[np.argmax(moved_m(registered, guesses)[edges])])
        found["least_fitness"] = int(edges[np.argmin(registered.fitness[edges])])
    if len(others):
        found["rejected"] = int(others[np.argmax(np.nan_to_num(registered.fitness[others], nan=-1.0))])
    return found


def moved_m(registered: Edges, guesses: Floats) -> Floats:
    """How far registration moved each pair (P,) from its guess, a rotation as its arc at 1 m; 0 where unknown."""
    motion = se3.log(se3.inverse(guesses) @ registered.i_from_j)
    return np.asarray(np.nan_to_num(np.linalg.norm(motion, axis=1)))


def _log_pair(
    stream: rr.RecordingStream, name: str, registered: Edges, row: int, guesses: Floats, clouds: CloudSet
) -> None:
    i, j = registered.pairs[row]
    source = np.asarray(_thinned(clouds, int(j)), float)
    for part, points, colour in (
        ("target", _thinned(clouds, int(i)), TARGET_COLOUR),
        ("before", np.asarray(se3.transform(guesses[row], source), np.float32), BEFORE_COLOUR),
        ("after", np.asarray(se3.transform(registered.i_from_j[row], source), np.float32), AFTER_COLOUR),
    ):
        shown = rr.Points3D(points, colors=[colour], radii=[POINT_RADIUS])
        stream.log(f"{layout.pair(name)}/{part}", shown, static=True)


def _thinned(clouds: CloudSet, row: int) -> Floats32:
    points = clouds[row].points_in_cam
    return np.asarray(points[evenly(len(points), POINTS_SHOWN)])


def _log_histogram(stream: rr.RecordingStream, path: str, values: Floats) -> None:
    known = values[np.isfinite(values)]
    if len(known):
        counts, ends = np.histogram(known, bins=BINS)
        middles, widths = (ends[1:] + ends[:-1]) / 2, np.diff(ends).astype(np.float32)
        stream.log(path, rr.BarChart(counts, abscissa=middles, widths=widths), static=True)


def _text(registered: Edges, guesses: Floats, chosen: Mapping[str, int]) -> str:
    moved = moved_m(registered, guesses)
    reasons, counts = np.unique(_reasons(registered), return_counts=True)
    outcomes = markdown_table(
        ("outcome", "pairs"), [(why or "edge", count) for why, count in zip(reasons, counts, strict=True)]
    )
    rows = []
    for name, row in chosen.items():
        i, j = registered.pairs[row]
        fitness, rmse_mm = f"{registered.fitness[row]:.2f}", f"{1000 * registered.rmse_m[row]:.1f} mm"
        moved_cm = f"{100 * moved[row]:.1f} cm"
        rows.append((name.replace("_", " "), f"{i} – {j}", fitness, rmse_mm, registered.iterations[row], moved_cm))
    shown = markdown_table(("shown", "i – j", "fitness", "RMSE", "iterations", "moved"), rows)
    colours = "Blue: frame i. Orange: frame j as guessed. Yellow: frame j as registered."
    return f"# Registration\n\n{outcomes}\n\n{colours}\n\n{shown}"
