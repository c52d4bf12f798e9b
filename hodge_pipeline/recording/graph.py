"""Log trajectories, the viewing graph and the iterations of a solve."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import rerun as rr

from hodge_pipeline import se3
from hodge_pipeline.recording import layout, shapes
from hodge_pipeline.recording.stream import Part, frame_columns, log_markdown, log_notes, story_columns
from hodge_pipeline.types import Edges, Floats, Frame, Ints, Solution, ViewGraph
from hodge_pipeline.types.arrays import evenly
from hodge_pipeline.types.text import markdown_table

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


def log_poses(part: Part, name: str, world_from_cam: Floats, frames: Sequence[Frame] = ()) -> None:
    """Log a trajectory as a line, as shapes (`pose_lines`) and as transforms."""
    drawable = np.flatnonzero(se3.has_pose(world_from_cam))
    sequences = np.array([frame.sequence for frame in frames] or [""] * len(world_from_cam), dtype=np.str_)
    colour = shapes.TRAJECTORY_COLOURS.get(name, shapes.RESULT_COLOUR)
    path = shapes.strips(world_from_cam, sequences)
    line = rr.LineStrips3D(
        path, colors=[colour], radii=[TRAJECTORY_RADIUS], labels=[name] * len(path), show_labels=False
    )
    part.stream.log(layout.trajectory(name), line, static=True)
    picked = drawable[evenly(len(drawable), FRUSTA)]
    lines = shapes.pose_lines(world_from_cam[picked], part.is_scanner)
    part.stream.log(layout.frusta(name), rr.LineStrips3D(lines, colors=[colour], radii=[FRUSTUM_RADIUS]), static=True)
    part.stream.send_columns(
        layout.poses(name),
        indexes=frame_columns(frames, len(world_from_cam), drawable),
        columns=rr.Transform3D.columns(
            translation=world_from_cam[drawable, :3, 3], quaternion=se3.to_quat_xyzw(world_from_cam[drawable])
        ),
    )
    if missing := len(world_from_cam) - len(drawable):
        part.note(f"{missing} of {len(world_from_cam)} poses of {name} are unknown and not drawn")


def log_edges(part: Part, outer: int, graph: ViewGraph, world_from_cam: Floats, rejected: Edges | None) -> None:
    """Log edges coloured by residual, and rejected pairs with the reason."""
    residual_m = shapes.residuals_m(graph, world_from_cam)
    colours = shapes.residual_colours(residual_m)
    size, what = LINE_BYTES + LABEL_BYTES, f"edges of round {outer} drawn"
    rows = part.some(graph.edge_count, shapes.MOST_LINES, size, part.solver_bytes / 2, what)
    labels = [_label(graph, int(row), residual_m) for row in rows]
    _log_lines(part.stream, layout.edges(outer), world_from_cam, graph.edges[rows], colours[rows], labels)
    if rejected is not None:
        what = f"rejected pairs of round {outer} drawn"
        rows = part.some(len(rejected), shapes.MOST_LINES, LINE_BYTES, part.solver_bytes / 4, what)
        pairs = rejected.pairs[rows]
        grey = np.full((len(pairs), 3), shapes.REJECTED_COLOUR, np.uint8)
        named = zip(graph.vertex_ids[pairs[:, 0]], graph.vertex_ids[pairs[:, 1]], rejected.why[rows], strict=True)
        labels = [f"{i} – {j}: rejected, {reason}" for i, j, reason in named]
        _log_lines(part.stream, layout.rejected(outer), world_from_cam, pairs, grey, labels)
    log_markdown(part.stream, layout.graph_text(outer), graph_summary(outer, graph, residual_m, rejected))


def log_solution(
    part: Part, outer: int, graph: ViewGraph, start: Floats, solution: Solution, first_iteration: int
) -> None:
    """Log the iterations of a solve, its scalars and the edges at its result."""
    states = [start, *(step.world_from_cam for step in solution.history)]
    states += [solution.world_from_cam] if not solution.history else []
    residuals = np.array([shapes.residuals_m(graph, poses) for poses in states]).reshape(len(states), graph.edge_count)
    for name, (rows, values) in solver_series(states, residuals, solution).items():
        indexes = iteration_columns(outer, len(states), first_iteration, rows)
        path = layout.under(layout.SOLVER_PLOTS, name)
        part.stream.send_columns(path, indexes, rr.Scalars.columns(scalars=values))
    if part.options.has_images:
        _log_film(part, outer, graph, states, residuals, first_iteration)
    colours = shapes.residual_colours(residuals[-1])
    colours[solution.weights == 0] = shapes.IGNORED_COLOUR
    what = f"solved edges of round {outer} drawn"
    lines = part.some(graph.edge_count, shapes.MOST_LINES, LINE_BYTES, part.solver_bytes / 4, what)
    final = solution.world_from_cam
    _log_lines(part.stream, layout.solved_edges(outer), final, graph.edges[lines], colours[lines], None)
    log_notes(part.stream, outer, solution.notes)


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
    rows: list[tuple[str, object]] = [("frames", graph.vertex_count), ("edges", graph.edge_count)]
    rows += [(f"… {name}", count) for name, count in zip(names, counts, strict=True)]
    if graph.vertex_count:
        spread = f"{degree.min()} / {degree.mean():.1f} / {degree.max()}"
        rows += [("edges of a frame, least / mean / most", spread)]
        rows += [("frames without an edge", np.count_nonzero(degree == 0))]
    if len(known):
        shown = " / ".join(f"{1000 * value:.1f}" for value in np.percentile(known, [50, 95, 100]))
        rows += [("residual, median / 95th / largest", f"{shown} mm")]
    if rejected is not None:
        rows += [("candidates that became no edge", len(rejected))]
    return f"# Viewing graph, round {outer}\n\n{markdown_table(('', ''), rows)}"


def _log_film(
    part: Part, outer: int, graph: ViewGraph, states: Sequence[Floats], residuals: Floats, first_iteration: int
) -> None:
    """Log edges and camera centres after each inner iteration; edges are thinned before iterations are."""
    drawn = np.flatnonzero(np.all([se3.has_pose(poses) for poses in states], axis=0))
    has_ends = np.isin(graph.edges, drawn).all(axis=1)
    options, max_bytes = part.options, part.solver_bytes / 2
    steps = options.count(FILM_STEPS, len(states), STEP_LINES * LINE_BYTES, max_bytes)
    rows = evenly(len(states), max(steps, 2))
    if len(rows) < len(states):
        part.note(f"film of round {outer} shows {len(rows)} of {len(states)} iterations")
    ends, what = np.flatnonzero(has_ends), f"film edges of round {outer} drawn"
    lines = ends[part.some(len(ends), shapes.MOST_LINES, LINE_BYTES * len(rows), max_bytes, what)]
    indexes = iteration_columns(outer, len(states), first_iteration, rows)
    if len(lines):
        strips = np.concatenate([shapes.segments(states[row], graph.edges[lines]) for row in rows])
        colours = shapes.residual_colours(residuals[np.ix_(rows, lines)].reshape(-1))
        columns = rr.LineStrips3D.columns(strips=strips, colors=colours).partition([len(lines)] * len(rows))
        part.stream.send_columns(layout.FILM_EDGES, indexes, columns)
        part.stream.log(layout.FILM_EDGES, rr.LineStrips3D.from_fields(radii=[EDGE_RADIUS]), static=True)
    centres = np.concatenate([states[row][drawn, :3, 3] for row in rows]).astype(np.float32)
    points = rr.Points3D.columns(positions=centres).partition([len(drawn)] * len(rows))
    part.stream.send_columns(layout.FILM_TRAJECTORY, indexes, points)
    style = rr.Points3D.from_fields(colors=[shapes.RESULT_COLOUR], radii=[CENTRE_RADIUS])
    part.stream.log(layout.FILM_TRAJECTORY, style, static=True)


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
