"""What a reader of a report should distrust, and what else is to be known."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from hodge_pipeline.evaluation.cloud_distance import NO_NEIGHBOUR_M, REACH_M
from hodge_pipeline.evaluation.difference import length
from hodge_pipeline.report import known_positions
from hodge_pipeline.report.contents import GRAPH_NAMES, TRUTH, GraphSummary, Report, TrajectoryRow, WrongEdges
from hodge_pipeline.rounds.settling import settled_m
from hodge_pipeline.types.notes import Note

LARGE_RESIDUAL_DEG = 5.0
"""Turns a point a little more than a metre away out of `REACH_M`, the residual of a position that is large."""
UNMATCHED_SHARE = 0.01
"""Of pairs, each of which counts as `NO_NEIGHBOUR_M`: at this share they add a millimetre to the mean distance."""
OTHER_SCALE, EXPLAINED = 1.1, 0.25
"""The factor between the true path and the result from which one is not in metres, if scaling by it leaves less than a
quarter of the error: focal lengths are known to a few per cent, and units differ by 5 or 1000.
"""
MOST_NAMED = 5
"""Frames without an edge that a note names: they fit on its line."""
NOTHING_MOVED_M = 0.0005
"""The least movement that is reported, in a room."""


def suspicions(report: Report) -> tuple[Note, ...]:
    """What a reader should distrust and what else is to be known, by rank; the run's own notes come first in each."""
    found = (
        *_unsettled(report),
        *_other_scale(report),
        *(() if report.position_fit is None else known_positions.notes(report.position_fit)),
        *report.notes,
        *(() if report.graph is None else _graph_suspicions(report.graph)),
        *_wrong_edges(report),
        *_edge_suspicions(report),
        *_above_truth(report),
        *_unmatched(report),
        *(note for row in report.trajectories for note in _trajectory_suspicions(row)),
    )
    return tuple(sorted(found, key=lambda note: note.rank))


def _unsettled(report: Report) -> Iterator[Note]:
    """A note where the last round moved the poses too far."""
    after = [path.positions for path in report.pictures.paths if path.name == report.after] or [np.zeros((0, 3))]
    if report.last_shift_m is not None and report.last_shift_m > settled_m(after[0], report.scale):
        yield Note("unsettled", detail=length(report.last_shift_m))


def _other_scale(report: Report) -> Iterator[Note]:
    """A note where the true path is a scaled copy of the result's, in the largest component."""
    paths = {path.name: path.positions for path in report.pictures.paths}
    if not report.has_metres or TRUTH not in paths or report.after not in paths:
        return
    x, y, component = paths[report.after], paths[TRUTH], report.pictures.component
    if len(component) != len(x):
        return
    rows = (component == np.bincount(component).argmax()) & np.isfinite(x + y).all(axis=1)
    if rows.sum() < 3:
        return
    x, y = x[rows] - x[rows].mean(axis=0), y[rows] - y[rows].mean(axis=0)
    scale = float(np.sum(x * y) / max(np.sum(x * x), np.finfo(float).tiny))
    left = np.sum((scale * x - y) ** 2)
    explained = left < EXPLAINED**2 * min(np.sum((x - y) ** 2), np.sum(y**2))  # of a camera that stayed, nothing is
    if explained and (scale > OTHER_SCALE or 0 < scale < 1 / OTHER_SCALE):
        yield Note("other scale", detail=f"{float(f'{scale:.2g}'):g}")


def _graph_suspicions(graph: GraphSummary) -> Iterator[Note]:
    if len(graph.components) > 1:
        yield Note("parts", len(graph.components))
    alone = [part.frames for part in graph.components if part.count == 1]
    if alone and graph.vertices > 1:
        named = ", ".join(alone[:MOST_NAMED]) + ", …" * (len(alone) > MOST_NAMED)
        yield Note("alone", len(alone), f"{graph.vertices} frames ({named})")
    if graph.edges_ignored:
        yield Note("edges ignored", graph.edges_ignored, str(graph.edges))
    if suspect := graph.verdicts_in_use.get("suspect", 0):
        yield Note("suspect", suspect)
    if untestable := graph.verdicts.get("untestable", 0):
        yield Note("untestable", untestable, str(graph.edges))


def _wrong_edges(report: Report) -> Iterator[Note]:
    """A note on the edges judged wrong, by their effect on the poses."""
    wrong = report.wrong_edges
    if wrong is None or not wrong.count:
        return
    moved = moved_without(wrong, report)
    if not wrong.matters(report.scale):
        yield Note("harmless", wrong.count, f"{wrong.frames}; without them no pose moves by more than {moved}")
    elif wrong.pieces_more:
        yield Note(
            "wrong", wrong.count, f"{wrong.frames}; without them the scene falls into {wrong.pieces_more} more pieces"
        )
    else:
        yield Note("wrong", wrong.count, f"{wrong.frames}; without them poses move by up to {moved}")


def moved_without(wrong: WrongEdges, report: Report) -> str:
    """By how much poses move without the wrong edges."""
    return report.length(max(wrong.moved_m, NOTHING_MOVED_M * report.scale))


def _above_truth(report: Report) -> Iterator[Note]:
    """A note where clouds fit better at the result than at the true poses."""
    table = report.scores
    if table is None or TRUTH not in table.names or report.after not in table.names:
        return
    truth, after = table.names.index(TRUTH), table.names.index(report.after)
    if any(graph.mean_score[after] > graph.mean_score[truth] for graph in table.graphs):
        yield Note("above truth")


def _edge_suspicions(report: Report) -> Iterator[Note]:
    large = [
        edge
        for edge in report.worst_edges
        if edge.weight > 0 and (edge.residual_m > _large_m(report) or edge.residual_deg > LARGE_RESIDUAL_DEG)
    ]
    if large:
        far = f"{length(_large_m(report))} or " if report.has_metres else ""
        yield Note("edges far off", len(large), f"{far}{LARGE_RESIDUAL_DEG:g}°")


def _large_m(report: Report) -> float:
    return REACH_M * report.scale if report.has_metres else float("inf")


def _unmatched(report: Report) -> Iterator[Note]:
    if report.scores is None:
        return
    for graph in report.scores.graphs:
        for name, unmatched, count in zip(report.scores.names, graph.unmatched, graph.counts, strict=True):
            if unmatched > UNMATCHED_SHARE * count:
                pairs = f"{unmatched} of {count} {GRAPH_NAMES[graph.kind]}"
                far = length(graph.scale * NO_NEIGHBOUR_M)
                yield Note("unmatched", int(unmatched), f"{name}: {pairs} have no point within {far}")


def _trajectory_suspicions(row: TrajectoryRow) -> Iterator[Note]:
    if row.left_out:
        yield Note("not in the error", row.left_out, f"{row.name}, {row.of}")
    if row.degenerate:
        yield Note("degenerate", detail=row.name)
