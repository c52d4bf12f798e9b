"""Line segments, frusta, colours and thinned models as plain arrays, without Rerun."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.diagnosis.result import CONSISTENT, SUSPECT, UNTESTABLE, WRONG
from hodge_pipeline.evaluation.residuals import edge_residuals
from hodge_pipeline.types import Bytes, Floats, Floats32, Ints, Model, ViewGraph
from hodge_pipeline.types.arrays import evenly

RESIDUAL_COLOURS = np.array([[60, 115, 225], [130, 145, 170], [190, 180, 120], [255, 225, 50]], float)
"""Blue to yellow, ever brighter: legible without red and green, and in grey; the worst edges stand out."""
VERDICT_COLOURS = {
    CONSISTENT: (60, 115, 225),
    UNTESTABLE: (127, 127, 127),
    SUSPECT: (230, 159, 0),
    WRONG: (213, 48, 143),
}
"""Blue, grey, amber, magenta: apart in hue and in brightness, on white paper and before the viewer's dark."""
IGNORED_COLOUR = VERDICT_COLOURS[WRONG]
REJECTED_COLOUR = (110, 110, 110)
RESULT_COLOUR = (255, 255, 255)
GREY = 190
"""Grey level of points without a colour."""
TRAJECTORY_COLOURS = {
    "truth": (0, 200, 140), "odometry": (230, 130, 0), "start": (185, 130, 235), "a": (230, 130, 0), "b": (86, 180, 233)
}  # fmt: skip
"""Bluish green, orange, purple, sky blue of Okabe and Ito's colour-blind safe set, brightened for a dark background."""

MOST_LINES = 20_000
"""Lines in one picture of the graph: more is a solid block."""
BRIGHT_M = 0.05
"""Metres: the residual at the bright end of the edges' colours; fixed, so that iterations and runs compare."""
LEAST_POSE_M, POSE_SHARE = 0.06, 0.02
"""Size of a drawn pose: metres at least, and a share of its trajectory's extent."""
_CORNERS = np.array([[-0.8, -0.6, 1.0], [0.8, -0.6, 1.0], [0.8, 0.6, 1.0], [-0.8, 0.6, 1.0]])
_FRUSTUM = np.vstack([_CORNERS, np.zeros((1, 3))])[[0, 4, 1, 2, 4, 3, 0, 1, 2, 3]]
_ARROW = np.array([[0, 0, 0.5], [0, 0, 0], [1, 0, 0], [0.7, 0.2, 0], [0.7, -0.2, 0], [1, 0, 0]])


def residuals_m(graph: ViewGraph, world_from_cam: Floats) -> Floats:
    """Residual (E,) of each edge in metres, `√(|t|² + (1 m · angle)²)`; NaN where a pose is not known."""
    translation_m, angle_rad = edge_residuals(graph, world_from_cam)
    return np.asarray(np.hypot(translation_m, se3.ARM_M * angle_rad))


def residual_colours(residual_m: Floats, scale_m: float = BRIGHT_M) -> Bytes:
    """RGB (..., 3) of residuals: dark blue at 0, bright yellow from `scale_m` on and for NaN."""
    share = np.clip(np.nan_to_num(np.asarray(residual_m, float) / scale_m, nan=1.0), 0.0, 1.0)
    stops = np.linspace(0, 1, len(RESIDUAL_COLOURS))
    channels: list[Floats] = [np.interp(share, stops, RESIDUAL_COLOURS[:, channel]) for channel in range(3)]
    return np.asarray(np.stack(channels, axis=-1).round(), np.uint8)


def segments(world_from_cam: Floats, pairs: Ints) -> Floats32:
    """Lines (P, 2, 3) between the camera centres of each pair."""
    return np.asarray(world_from_cam[pairs, :3, 3], np.float32)


def or_grey(colours: Bytes | None, count: int) -> Bytes:
    """Colours (count, 3); grey where none is known."""
    return colours if colours is not None and colours.any() else np.full((count, 3), GREY, np.uint8)


def strips(world_from_cam: Floats, sequences: np.ndarray[tuple[int, ...], np.dtype[np.str_]]) -> list[Floats32]:
    """Lines through the camera centres, broken where a sequence ends or a pose is missing."""
    drawable = se3.has_pose(world_from_cam)
    broken = (sequences[1:] != sequences[:-1]) | ~drawable[1:] | ~drawable[:-1]
    runs = np.split(np.arange(len(drawable)), np.flatnonzero(broken) + 1)
    return [np.asarray(world_from_cam[run, :3, 3], np.float32) for run in runs if len(run) and drawable[run[0]]]


def pose_lines(world_from_cam: Floats, is_scanner: bool) -> Floats32:
    """One line (N, K, 3) for each pose: the frustum of a camera, x right and z forward; of a scanner an arrow along its
    x, under a mast along its z.
    """
    extent_m = np.linalg.norm(np.ptp(world_from_cam[:, :3, 3], axis=0)) if len(world_from_cam) else 0.0
    shape = max(LEAST_POSE_M, POSE_SHARE * float(extent_m)) * (_ARROW if is_scanner else _FRUSTUM)
    return np.asarray(se3.transform(world_from_cam, shape), np.float32)


def thin_model(model: Model, kept: int) -> Model:
    """The model with about `kept` points at most: points left out evenly, a mesh clustered in voxels."""
    if len(model.points_in_world) <= kept:
        return model
    if model.triangles is None:
        return _kept(model, evenly(len(model.points_in_world), kept), None)
    return _clustered(model, kept)


def _clustered(model: Model, kept: int) -> Model:
    points = np.asarray(model.points_in_world, float)
    low = points.min(axis=0)
    voxel_m = max(float(np.ptp(points, axis=0).max()) / 2000, 1e-9)
    while True:
        cells = np.floor((points - low) / voxel_m).astype(np.int64)
        voxels = numbered(cells, cells.max(axis=0) + 1)
        _, first, cluster = np.unique(voxels, return_index=True, return_inverse=True)
        if len(first) <= kept:
            break
        voxel_m *= max(1.05, float(np.sqrt(len(first) / kept)))
    triangles = cluster.reshape(-1)[np.asarray(model.triangles)]
    a, b, c = triangles.T
    return _kept(model, first, triangles[(a != b) & (b != c) & (a != c)].astype(np.int32))


def numbered(cells: Ints, size: Ints) -> Ints:
    """A number (N,) for each cell (N, 3) of a grid of this size (3,)."""
    return np.asarray((cells[:, 0] * size[1] + cells[:, 1]) * size[2] + cells[:, 2])


def _kept(model: Model, rows: Ints, triangles: np.ndarray[tuple[int, ...], np.dtype[np.int32]] | None) -> Model:
    """The model of these of its points alone."""
    normals = None if model.normals_in_world is None else model.normals_in_world[rows]
    colours = None if model.colours is None else model.colours[rows]
    points = model.points_in_world[rows]
    return replace(model, points_in_world=points, normals_in_world=normals, colours=colours, triangles=triangles)
