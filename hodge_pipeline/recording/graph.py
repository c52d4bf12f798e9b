"""Log trajectories, the viewing graph and the iterations of a solve."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import rerun as rr

from hodge_pipeline import se3
from hodge_pipeline.recipe.recording_options import RecordingOptions
from hodge_pipeline.recording import layout, shapes
from hodge_pipeline.recording.stream import frame_columns, log_markdown, log_notes, story_columns
from hodge_pipeline.types import Edges, Floats, Frame, Ints, Solution, ViewGraph
from hodge_pipeline.types.arrays import evenly

LINE_BYTES = 40
"""One edge of the film: two points, a colour, two list offsets."""
LABEL_BYTES = 60
FILM_STEPS = 60
"""Inner iterations of one solve that are drawn; the scalars are kept for all."""
STEP_LINES = 200
"""Iterations are left out of the film only where fewer lines than this would be left in each."""

FRUSTA = 60
"""Drawn along one trajectory."""
TRAJECTORY_RADIUS, FRUSTUM_RADIUS, EDGE_RADIUS, CENTRE_RADIUS = -1.6, -0.5, -0.6, -2.0
"""Rerun takes a negative radius as points on the screen, so that lines stay legible at every distance."""


def log_poses(
    stream: rr.RecordingStream,
    name: str,
    world_from_cam: Floats,
    frames: Sequence[Frame],
    is_scanner: bool,
) -> tuple[str, ...]:
    """Log a trajectory as a line, as shapes (`pose_lines`) and as transforms; gives notes of what was left out."""
    drawable = np.flatnonzero(shapes.is_drawable(world_from_cam))
    sequences = np.array([frame.sequence for frame in frames] or [""] * len(world_from_cam), dtype=np.str_)
    colour = shapes.TRAJECTORY_COLOURS.get(name, shapes.RESULT_COLOUR)
    path = shapes.strips(world_from_cam, sequences)
    line = rr.LineStrips3D(
        path, colors=[colour], radii=[TRAJECTORY_RADIUS], labels=[name] * len(path), show_labels=False
    )
    stream.log(layout.trajectory(name), line, static=True)
    picked = drawable[evenly(len(drawable), FRUSTA)]
    lines = shapes.pose_lines(world_from_cam[picked], is_scanner)
    stream.log(layout.frusta(name), rr.LineStrips3D(lines, colors=[colour], radii=[FRUSTUM_RADIUS]), static=True)
    stream.send_columns(
        layout.poses(name),
        indexes=frame_columns(frames, len(world_from_cam), drawable),
        columns=rr.Transform3D.columns(
            translation=world_from_cam[drawable, :3, 3], quaternion=se3.to_quat_xyzw(world_from_cam[drawable])
        ),
    )
    missing = len(world_from_cam) - len(drawable)
    notes = (f"recording: {missing} of {len(world_from_cam)} poses of {name} are unknown and not drawn",)
    return _noted(stream, 0, notes if missing else ())


def log_edges(
    stream: rr.RecordingStream,
    outer: int,
    graph: ViewGraph,
    world_from_cam: Floats,
    rejected: Edges | None,
    options: RecordingOptions,
    max_bytes: float,
) -> tuple[str, ...]:
    """Log edges coloured by residual, and rejected pairs with the reason; gives notes of what was thinned."""
    residual_m = shapes.residuals_m(graph, world_from_cam)
    colours = shapes.residual_colours(residual_m, options.residual_scale_m)
    kept = options.count(shapes.MOST_LINES, graph.edge_count, LINE_BYTES + LABEL_BYTES, max_bytes / 2)
    rows = evenly(graph.edge_count, kept)
    labels = [_label(graph, int(row), residual_m) for row in rows]
    _log_lines(stream, layout.edges(outer), world_from_cam, graph.edges[rows], colours[rows], labels)
    if rejected is not None:
        kept = options.count(shapes.MOST_LINES, len(rejected.pairs), LINE_BYTES, max_bytes / 4)
        pairs = rejected.pairs[evenly(len(rejected.pairs), kept)]
        grey = np.full((len(pairs), 3), shapes.REJECTED_COLOUR, np.uint8)
        why = rejected.why[evenly(len(rejected.pairs), kept)]
        named = zip(graph.vertex_ids[pairs[:, 0]], graph.vertex_ids[pairs[:, 1]], why, strict=True)
        labels = [f"{i} – {j}: rejected, {reason}" for i, j, reason in named]
        _log_lines(stream, layout.rejected(outer), world_from_cam, pairs, grey, labels)
    log_markdown(stream, layout.graph_text(outer), graph_summary(outer, graph, residual_m, rejected))
    return _noted(stream, outer, _thinning("edges", len(rows), graph.edge_count, outer))


def log_solution(
    stream: rr.RecordingStream,
    outer: int,
    graph: ViewGraph,
    start: Floats,
    solution: Solution,
    first_iteration: int,
    options: RecordingOptions,
    max_bytes: float,
) -> tuple[str, ...]:
    """Log the iterations of a solve, its scalars and the edges at its result; gives notes of what was thinned."""
    states = [start, *(step.world_from_cam for step in solution.history)]
    states += [solution.world_from_cam] if not solution.history else []
    residuals = np.array([shapes.residuals_m(graph, poses) for poses in states]).reshape(len(states), graph.edge_count)
    for name, (rows, values) in solver_series(states, residuals, solution).items():
        indexes = iteration_columns(outer, len(states), first_iteration, rows)
        stream.send_columns(layout.under(layout.SOLVER_PLOTS, name), indexes, rr.Scalars.columns(scalars=values))
    notes: list[str] = []
    if options.has_images:
        notes += _log_film(stream, outer, graph, states, residuals, first_iteration, options, max_bytes / 2)
    colours = shapes.residual_colours(residuals[-1], options.residual_scale_m)
    colours[solution.weights == 0] = shapes.IGNORED_COLOUR
    lines = evenly(graph.edge_count, options.count(shapes.MOST_LINES, graph.edge_count, LINE_BYTES, max_bytes / 4))
    final = solution.world_from_cam
    _log_lines(stream, layout.solved_edges(outer), final, graph.edges[lines], colours[lines], None)
    log_notes(stream, outer, solution.notes)
    return _noted(stream, outer, notes + list(_thinning("solved edges", len(lines), graph.edge_count, outer)))


def solver_series(states: Sequence[Floats], residuals: Floats, solution: Solution) -> Mapping[str, tuple[Ints, Floats]]:
    """Rows and values of each scalar over the iterations; row 0 is the start, without objective and step."""
    count = len(states)
    series: dict[str, tuple[Ints, Floats]] = {}
    known = np.isfinite(residuals).any(axis=1) if residuals.size else np.zeros(count, bool)
    if known.all():
        series["residual_mean_m"] = (np.arange(count), np.nanmean(residuals, axis=1))
        series["residual_95th_m"] = (np.arange(count), np.nanpercentile(residuals, 95, axis=1))
    moved = [np.linalg.norm(b[:, :3, 3] - a[:, :3, 3], axis=1) for a, b in zip(states, states[1:], strict=False)]
    series["step_max_m"] = (np.arange(1, count), np.array([np.nanmax(m, initial=0.0) for m in moved]))
    history = solution.history
    rows = np.arange(1, len(history) + 1)
    series["objective"] = (rows, np.array([step.objective for step in history]))
    for name in sorted({name for step in history for name in step.metrics}):
        having = np.array([name in step.metrics for step in history])
        series[name] = (rows[having], np.array([step.metrics[name] for step in history if name in step.metrics]))
    return {name: (rows, values) for name, (rows, values) in series.items() if len(rows)}


def iteration_columns(outer: int, count: int, first_iteration: int, rows: Ints) -> list[rr.TimeColumn]:
    """The times of inner iterations `rows` of `count`: the running number of the run, and the round's story slot."""
    return [
        rr.TimeColumn(layout.ITERATION, sequence=first_iteration + rows),
        *story_columns(outer, rows / max(count, 1)),
    ]


def graph_summary(outer: int, graph: ViewGraph, residual_m: Floats, rejected: Edges | None) -> str:
    """The viewing graph's counts as Markdown."""
    degree = np.bincount(graph.edges.ravel(), minlength=graph.vertex_count)
    names, counts = np.unique(graph.source, return_counts=True)
    known = residual_m[np.isfinite(residual_m)]
    lines = [f"# Viewing graph, round {outer}", "", "| | |", "|---|---|", f"| frames | {graph.vertex_count} |"]
    lines += [f"| edges | {graph.edge_count} |"]
    lines += [f"| … {name} | {count} |" for name, count in zip(names, counts, strict=True)]
    if graph.vertex_count:
        lines += [f"| edges of a frame, least / mean / most | {degree.min()} / {degree.mean():.1f} / {degree.max()} |"]
        lines += [f"| frames without an edge | {np.count_nonzero(degree == 0)} |"]
    if len(known):
        lines += [f"| residual, median / 95th / largest | {_millimetres(known)} |"]
    if rejected is not None:
        lines += [f"| candidates that became no edge | {len(rejected.pairs)} |"]
    return "\n".join(lines)


def _millimetres(residual_m: Floats) -> str:
    return " / ".join(f"{1000 * value:.1f}" for value in np.percentile(residual_m, [50, 95, 100])) + " mm"


def _log_film(
    stream: rr.RecordingStream,
    outer: int,
    graph: ViewGraph,
    states: Sequence[Floats],
    residuals: Floats,
    first_iteration: int,
    options: RecordingOptions,
    max_bytes: float,
) -> list[str]:
    """Log edges and camera centres after each inner iteration; edges are thinned before iterations are."""
    drawn = np.flatnonzero(np.all([shapes.is_drawable(poses) for poses in states], axis=0))
    has_ends = np.isin(graph.edges, drawn).all(axis=1)
    available = int(np.count_nonzero(has_ends))
    steps = options.count(FILM_STEPS, len(states), STEP_LINES * LINE_BYTES, max_bytes)
    rows = evenly(len(states), max(steps, 2))
    kept = options.count(shapes.MOST_LINES, available, LINE_BYTES * len(rows), max_bytes)
    lines = np.flatnonzero(has_ends)[evenly(available, kept)]
    indexes = iteration_columns(outer, len(states), first_iteration, rows)
    if len(lines):
        strips = np.concatenate([shapes.segments(states[row], graph.edges[lines]) for row in rows])
        colours = shapes.residual_colours(residuals[np.ix_(rows, lines)].reshape(-1), options.residual_scale_m)
        columns = rr.LineStrips3D.columns(strips=strips, colors=colours).partition([len(lines)] * len(rows))
        stream.send_columns(layout.FILM_EDGES, indexes, columns)
        stream.log(layout.FILM_EDGES, rr.LineStrips3D.from_fields(radii=[EDGE_RADIUS]), static=True)
    centres = np.concatenate([states[row][drawn, :3, 3] for row in rows]).astype(np.float32)
    points = rr.Points3D.columns(positions=centres).partition([len(drawn)] * len(rows))
    stream.send_columns(layout.FILM_TRAJECTORY, indexes, points)
    style = rr.Points3D.from_fields(colors=[shapes.RESULT_COLOUR], radii=[CENTRE_RADIUS])
    stream.log(layout.FILM_TRAJECTORY, style, static=True)
    notes = [f"recording: film of round {outer} shows {len(rows)} of {len(states)} iterations"]
    thinned = _thinning("film edges", len(lines), graph.edge_count, outer)
    return (notes if len(rows) < len(states) else []) + list(thinned)


def _log_lines(
    stream: rr.RecordingStream,
    path: str,
    world_from_cam: Floats,
    pairs: Ints,
    colours: np.ndarray[tuple[int, ...], np.dtype[np.uint8]],
    labels: list[str] | None,
) -> None:
    lines = shapes.segments(world_from_cam, pairs)
    drawn = np.asarray(np.isfinite(lines).all(axis=(1, 2)))
    names = None if labels is None else [label for label, keep in zip(labels, drawn, strict=True) if keep]
    strips = rr.LineStrips3D(lines[drawn], colors=colours[drawn], radii=[EDGE_RADIUS], labels=names, show_labels=False)
    stream.log(path, strips, static=True)


def _label(graph: ViewGraph, row: int, residual_m: Floats) -> str:
    i, j = (graph.vertex_ids[k] for k in graph.edges[row])
    fitness = "" if np.isnan(graph.fitness[row]) else f", fitness {graph.fitness[row]:.2f}"
    return f"{i} – {j}: {graph.source[row]}, {1000 * residual_m[row]:.1f} mm{fitness}"


def _thinning(what: str, kept: int, available: int, outer: int) -> tuple[str, ...]:
    return (f"recording: {kept} of {available} {what} of round {outer} drawn",) if kept < available else ()


def _noted(stream: rr.RecordingStream, slot: int, notes: Sequence[str]) -> tuple[str, ...]:
    log_notes(stream, slot, notes)
    return tuple(notes)
