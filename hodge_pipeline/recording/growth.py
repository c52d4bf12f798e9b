"""Log the model growing over time: each point appears with the first frame that saw it."""

from __future__ import annotations

import numpy as np
import rerun as rr

from hodge_pipeline import se3
from hodge_pipeline.recipe.recording_options import RecordingOptions
from hodge_pipeline.recording import layout, shapes
from hodge_pipeline.recording.stream import story_columns
from hodge_pipeline.types import CloudSet, Floats, Floats32, Ints, Model
from hodge_pipeline.types.arrays import evenly

STEPS = 24
MOST_POINTS = 120_000
POINT_BYTES = 16
CELL_M = 0.06
"""Twice the usual cloud's grid: a fused point and the measured one beside it are in the same or the next cell."""
POINT_RADIUS = -1.2


def log_growth(
    stream: rr.RecordingStream,
    model: Model,
    clouds: CloudSet,
    world_from_cam: Floats,
    slot: int,
    options: RecordingOptions,
) -> None:
    """Log the model's points in `STEPS` entities, each of which appears with its first frame."""
    kept = options.count(MOST_POINTS, len(model.points_in_world), POINT_BYTES, options.max_bytes("model") / 2)
    rows = evenly(len(model.points_in_world), min(kept, MOST_POINTS))
    if not options.has_images or not len(rows) or not len(clouds):
        return
    points = model.points_in_world[rows]
    colours = None if model.colours is None else model.colours[rows]
    first = first_frame(points, clouds, world_from_cam)
    cuts = np.unique(np.linspace(0, len(clouds), STEPS + 1).astype(np.int64))
    for step, (start, end) in enumerate(zip(cuts, cuts[1:], strict=False)):
        lot = np.flatnonzero((first >= start) & (first < end))
        if not len(lot):
            continue
        coloured = None if colours is None else colours[lot]
        columns = rr.Points3D.columns(positions=points[lot], colors=coloured).partition([len(lot)])
        share = np.array([step / STEPS])
        times = [rr.TimeColumn(layout.FRAME, sequence=np.array([start])), *story_columns(slot, share)]
        stream.send_columns(layout.growth(step), times, columns)
        stream.log(layout.growth(step), rr.Points3D.from_fields(radii=[POINT_RADIUS]), static=True)


def first_frame(points: Floats32, clouds: CloudSet, world_from_cam: Floats) -> Ints:
    """The row of the first frame whose cloud reaches the cell of each point (P,) or one beside it; else the last."""
    frames = np.repeat(np.arange(len(clouds)), clouds.sizes)
    known = shapes.is_drawable(world_from_cam)[frames]
    seen = _in_world(clouds, world_from_cam)[known]
    every = np.concatenate([seen, points]) if len(seen) else points
    low = np.floor(every.min(axis=0) / CELL_M).astype(np.int64) - 1
    size = np.floor(every.max(axis=0) / CELL_M).astype(np.int64) - low + 2
    cells = np.floor(seen / CELL_M).astype(np.int64) - low
    keys, first = np.unique((cells[:, 0] * size[1] + cells[:, 1]) * size[2] + cells[:, 2], return_index=True)
    found = np.full(len(points), len(clouds) - 1)
    if not len(keys):
        return found
    own = np.floor(points / CELL_M).astype(np.int64) - low
    for step in np.array([[0, 0, 0], *np.eye(3, dtype=int), *-np.eye(3, dtype=int)]):
        cell = own + step
        wanted = (cell[:, 0] * size[1] + cell[:, 1]) * size[2] + cell[:, 2]
        place = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
        hit = keys[place] == wanted
        found[hit] = np.minimum(found[hit], frames[known][first[place[hit]]])
    return found


def _in_world(clouds: CloudSet, world_from_cam: Floats) -> Floats32:
    parts = [
        se3.transform(world_from_cam[row], np.asarray(clouds[row].points_in_cam, float)) for row in range(len(clouds))
    ]
    return np.concatenate([np.zeros((0, 3)), *parts]).astype(np.float32)
