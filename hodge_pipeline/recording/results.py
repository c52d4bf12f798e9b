"""Log the fused model, the scores, the recipe and the run's log."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import rerun as rr

from hodge_pipeline.recording import layout, shapes
from hodge_pipeline.recording.stream import Part, frame_columns, log_markdown, log_notes, story_columns
from hodge_pipeline.types import Floats, Frame, Model

VERTEX_BYTES = 28
"""A vertex with normal and colour; a triangle has `TRIANGLE_BYTES`, and there are about two for each vertex."""
TRIANGLE_BYTES = 12
MODEL_POINTS = 250_000
"""Points or vertices of the fused model; a laptop's viewer stays fluid."""
POINT_RADIUS = -1.2
"""Negative: points on the screen."""

LEVELS = {"WARNING": "WARN", "ERROR": "ERROR", "CRITICAL": "CRITICAL", "DEBUG": "DEBUG"}
"""Rerun's words for those of `logging`; the others are INFO."""


def log_model(part: Part, model: Model, path: str = layout.MODEL) -> None:
    """Log the fused scene as a static mesh or point cloud."""
    stream, available = part.stream, len(model.points_in_world)
    bytes_each = VERTEX_BYTES + (0 if model.triangles is None else 2 * TRIANGLE_BYTES)
    kept = part.options.count(MODEL_POINTS, available, bytes_each, part.options.max_bytes("model"))
    thin = shapes.thin_model(model, max(kept, 1))
    if thin.triangles is None or not len(thin.triangles):
        colours = shapes.or_grey(thin.colours, len(thin.points_in_world))
        cloud = rr.Points3D(thin.points_in_world, colors=colours, radii=[POINT_RADIUS])
        stream.log(path, cloud, static=True)
    else:
        # Only the side that was seen is drawn, so that a room can be looked into from outside.
        mesh = rr.Mesh3D(
            vertex_positions=thin.points_in_world,
            triangle_indices=thin.triangles,
            vertex_normals=thin.normals_in_world,
            vertex_colors=thin.colours,
            face_rendering=rr.components.MeshFaceRendering.Front,
        )
        stream.log(path, mesh, static=True)
    log_notes(stream, part.slot, model.notes)
    if len(thin.points_in_world) < available:
        part.note(f"{len(thin.points_in_world)} of {available} points of model {model.name}")


def log_evaluation(
    part: Part,
    frames: Sequence[Frame],
    per_frame: Mapping[str, Floats],
    tables: Mapping[str, str],
) -> None:
    """Series over the frames (NaN where a frame has no score), and tables in Markdown."""
    for name, values in per_frame.items():
        rows = np.flatnonzero(np.isfinite(values))
        if len(rows):
            indexes = frame_columns(frames, len(values), rows)
            scalars = rr.Scalars.columns(scalars=np.asarray(values, float)[rows])
            part.stream.send_columns(layout.under(layout.FRAME_PLOTS, name), indexes, scalars)
    text = "\n\n".join(f"## {title}\n\n{table}" for title, table in tables.items())
    log_markdown(part.stream, layout.SCORES, text or "No scores.")


def log_text(part: Part, recipe: str, log_lines: Sequence[str], slots: int) -> None:
    """The resolved recipe, and the run's log spread over the story."""
    log_markdown(part.stream, layout.RECIPE, f"```yaml\n{recipe}\n```")
    if log_lines:
        share = slots * np.arange(len(log_lines)) / len(log_lines)
        part.stream.send_columns(
            layout.LOG,
            indexes=story_columns(0, share),
            columns=rr.TextLog.columns(text=list(log_lines), level=[level_of(line) for line in log_lines]),
        )


def level_of(line: str) -> str:
    """The level of a line of a run's log, which stands behind its date and time."""
    words = line.split(maxsplit=3)
    return LEVELS.get(words[2] if len(words) > 2 else "", "INFO")
