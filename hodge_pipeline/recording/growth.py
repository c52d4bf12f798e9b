"""Log the model growing over time: each point appears with the first frame that saw it."""

from __future__ import annotations

import numpy as np
import rerun as rr
from scipy.spatial import cKDTree

from hodge_pipeline import se3
from hodge_pipeline.recording import layout, shapes
from hodge_pipeline.recording.stream import Part, story_columns
from hodge_pipeline.types import CloudSet, Floats, Floats32, Ints, Model
from hodge_pipeline.types.arrays import evenly

STEPS = 24
MOST_POINTS = 120_000
POINT_BYTES = 16
USUAL_GRID_M = 0.03
"""Distance between the points of a cloud, by the recipes for rooms."""
GRIDS = 2.0
"""Side of a cell, in distances between points: a fused point and its measured neighbour are in the same or the next."""
POINT_RADIUS = -1.2


def log_growth(part: Part, model: Model, clouds: CloudSet, world_from_cam: Floats, slot: int) -> None:
    """Log the model's points in `STEPS` entities, each from the time on at which its first frame saw it."""
    stream, options = part.stream, part.options
    kept = options.count(MOST_POINTS, len(model.points_in_world), POINT_BYTES, options.max_bytes("model") / 2)
    rows = evenly(len(model.points_in_world), min(kept, MOST_POINTS))
    if not options.has_images or not len(rows) or not len(clouds):
        return
    points = model.points_in_world[rows]
    colours = shapes.or_grey(model.colours, len(model.points_in_world))[rows]
    first = first_frame(points, clouds, world_from_cam)
    cuts = np.unique(np.linspace(0, len(clouds), STEPS + 1).astype(np.int64))
    for step, (start, end) in enumerate(zip(cuts, cuts[1:], strict=False)):
        lot = np.flatnonzero((first >= start) & (first < end))
        if not len(lot):
            continue
        columns = rr.Points3D.columns(positions=points[lot], colors=colours[lot]).partition([len(lot)])
        share = np.array([step / STEPS])
        times = [rr.TimeColumn(layout.FRAME, sequence=np.array([start])), *story_columns(slot, share)]
        stream.send_columns(layout.growth(step), times, columns)
        stream.log(layout.growth(step), rr.Points3D.from_fields(radii=[POINT_RADIUS]), static=True)


def first_frame(points: Floats32, clouds: CloudSet, world_from_cam: Floats) -> Ints:
    """The first row whose cloud has a point in the cell of each point (P,), or in one beside it; else the last row."""
    found = np.full(len(points), len(clouds) - 1)
    known = np.flatnonzero(se3.has_pose(world_from_cam) & (clouds.sizes > 0))
    if not len(points) or not len(known):
        return found
    cell_m = GRIDS * grid_m(np.asarray(clouds[int(known[len(known) // 2])].points_in_cam, float))
    cells = np.floor(points.astype(float) / cell_m).astype(np.int64)
    low = cells.min(axis=0) - 1
    size = cells.max(axis=0) + 2 - low
    around = (cells[:, None] + [[0, 0, 0], *np.eye(3, dtype=int), *-np.eye(3, dtype=int)]).reshape(-1, 3)
    keys, cell_of = np.unique(shapes.numbered(around - low, size), return_inverse=True)
    first = np.full(len(keys), len(clouds) - 1)
    for row, cloud in zip(known[::-1], clouds.read(known[::-1]), strict=True):
        seen = se3.transform(world_from_cam[row], np.asarray(cloud.points_in_cam, float))
        own = np.floor(seen / cell_m).astype(np.int64) - low
        own = shapes.numbered(own[((own >= 0) & (own < size)).all(axis=1)], size)
        place = np.minimum(np.searchsorted(keys, own), len(keys) - 1)
        first[place[keys[place] == own]] = row
    return np.asarray(first[cell_of.reshape(len(points), -1)].min(axis=1))


def grid_m(points: Floats) -> float:
    """The median distance to the nearest neighbour in a cloud (P, 3); `USUAL_GRID_M` for a single point."""
    if len(points) < 2:
        return USUAL_GRID_M
    return max(float(np.median(cKDTree(points).query(points, k=2)[0][:, 1])), float(np.finfo(np.float32).eps))
