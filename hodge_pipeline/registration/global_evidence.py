"""Evidence on a registration without a guess: free-space violations, and motions that the surfaces leave free."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import maximum_filter, minimum_filter

from hodge_pipeline import se3
from hodge_pipeline.complex.free_directions import named_direction
from hodge_pipeline.types import Bools, Camera, Floats, Floats32, Ints

SLIPPAGE = 0.015
"""Eigenvalue of the mean normal matrix of a free motion: normals that differ by less than 7° are one plane."""
FEWEST_SEEN = 30
"""Points, at least, of which a share is told: its standard error is 9 % at most."""
VIEW_WIDTH = 160
"""Pixels across a small depth image, one in 4 of 640."""
CLOUD_VIEW_WIDTH = 80
"""Pixels across the view of a cloud: with their neighbours they are as wide as its voxels, 3 cm, at 1.5 m."""
MARGIN_M, MARGIN_PER_M2 = 0.06, 0.006
"""Depth noise of structured light grows with the square of the distance; a match is off by centimetres."""
NEAREST_M = 0.1
"""Metres from the sensor, nearer than a depth camera measures: only a wrong motion puts points there."""
PANORAMA_STEP = np.radians(3.0)
"""Side of a panorama's cell: that of a scan's voxels at 6 m in a room."""
STREET_SCALE = 5.0
"""Scale from which violations may be traffic; in rooms look-alike places may differ only in what stands in them."""
DIRECTIONS, BUSY_DIRECTIONS, QUIET_SHARE = 12, 3, 0.03
"""Sectors of a panorama; those with most violations, which may be traffic; the greatest violation of the others if so:
vehicles are in few sectors, violations of a wrong motion in all. In modelled streets with 6 to 30 vehicles each way on
500 m the others have more in 13 % of 112 right pairs, and in all of 252 wrong optima of GICP (0.07 at least).
"""


@dataclass(frozen=True)
class DepthView:
    """A depth image made small: the nearest surface around each kept pixel in metres, ∞ where nothing was measured.

    Without a camera it is a panorama: rows are elevations from −90°, columns azimuths about z, lengths are ranges.
    """

    nearest_m: Floats32
    stride: int
    camera: Camera | None

    def project(self, points: Floats, nearest_m: float) -> tuple[Ints, Ints, Floats]:
        """Row, column and depth in metres of those points (N, 3) in the view's frame that lie in the image."""
        if self.camera is None:
            ranges = np.linalg.norm(points, axis=1)
            far = ranges > nearest_m
            return *_cells(points[far], ranges[far]), ranges[far]
        front = points[points[:, 2] > nearest_m]
        z = front[:, 2]
        with np.errstate(over="ignore", invalid="ignore"):
            column = np.rint((self.camera.fx * front[:, 0] / z + self.camera.cx) / self.stride)
            row = np.rint((self.camera.fy * front[:, 1] / z + self.camera.cy) / self.stride)
        height, width = self.nearest_m.shape
        inside: Bools = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        return row[inside].astype(np.int64), column[inside].astype(np.int64), z[inside]


def depth_view(depth: Floats32, camera: Camera) -> DepthView:
    """Every n-th pixel, about 160 a row, each the nearest of its neighbours, so that depth edges are no violations."""
    stride = max(1, depth.shape[1] // VIEW_WIDTH)
    small = depth[::stride, ::stride]
    open_ended = np.where(small > 0, small, np.float32(np.inf)).astype(np.float32)
    return DepthView(minimum_filter(open_ended, 3, mode="nearest"), stride, camera)


def cloud_view(points: Floats, camera: Camera, scale: float = 1.0) -> DepthView:
    """The view of a depth image from its down-sampled cloud (N, 3): the nearest of its points in and around each pixel.

    It costs half a millisecond, a tenth of reading the image again.
    """
    stride = max(1, camera.width // CLOUD_VIEW_WIDTH)
    height, width = -(-camera.height // stride), -(-camera.width // stride)
    view = DepthView(np.full((height, width), np.inf, np.float32), stride, camera)
    row, column, z = view.project(points, NEAREST_M * scale)
    np.minimum.at(view.nearest_m, (row, column), z.astype(np.float32))
    return DepthView(minimum_filter(view.nearest_m, 3, mode="nearest"), stride, camera)


def panorama(points: Floats) -> DepthView:
    """The panorama of a scan (N, 3) from its origin: the nearest range in and around each cell of directions.

    ∞ where the cell, or the one above or below it, holds no point: at the edge of the view, or between rings that are
    far apart, free space is unknown.
    """
    ranges = np.linalg.norm(points, axis=1)
    nearest = np.full((round(np.pi / PANORAMA_STEP), round(2 * np.pi / PANORAMA_STEP)), np.inf, np.float32)
    np.minimum.at(nearest, _cells(points, ranges), ranges.astype(np.float32))
    beside_unseen = maximum_filter(nearest, (3, 1), mode="nearest") == np.inf
    nearest = minimum_filter(nearest, 3, mode=("nearest", "wrap"))
    return DepthView(np.where(beside_unseen, np.float32(np.inf), nearest), 1, None)


def _cells(points: Floats, ranges: Floats) -> tuple[Ints, Ints]:
    """Row and column in a panorama of points (N, 3) at these ranges."""
    rows, columns = round(np.pi / PANORAMA_STEP), round(2 * np.pi / PANORAMA_STEP)
    up = np.arcsin(np.clip(points[:, 2] / np.maximum(ranges, 1e-12), -1, 1)) + np.pi / 2
    turn = np.arctan2(points[:, 1], points[:, 0]) + np.pi
    row, column = ((angle / PANORAMA_STEP).astype(np.int64) for angle in (up, turn))
    return np.minimum(row, rows - 1), column % columns


@dataclass(frozen=True)
class FreeSpace:
    """Of the points projected into a view: how many lie before its surface, and how many on it."""

    before: int
    on: int

    @property
    def violation(self) -> float:
        """The share that the view saw through; NaN where too few lie before or on its surface to tell."""
        total = self.before + self.on
        return self.before / total if total >= FEWEST_SEEN else float("nan")


def free_space(view: DepthView, points_in_view: Floats, scale: float = 1.0) -> FreeSpace:
    """How many points (N, 3) of another frame, moved into this view, lie before its surface and on it.

    In streets the sectors of most violations are left out where the others have none to speak of: that is traffic.
    `scale` multiplies lengths that are for rooms.
    """
    row, column, z = view.project(points_in_view, NEAREST_M * scale)
    surface = view.nearest_m[row, column]
    margin = MARGIN_M * scale + MARGIN_PER_M2 / scale * z**2
    measured = np.isfinite(surface)
    before = measured & (z < surface - margin)
    on = measured & (np.abs(z - surface) <= margin)
    every = FreeSpace(int(before.sum()), int(on.sum()))
    if view.camera is not None or scale < STREET_SCALE:
        return every
    direction = column * DIRECTIONS // view.nearest_m.shape[1]
    quiet = np.isin(direction, np.argsort(np.bincount(direction[before], minlength=DIRECTIONS))[:-BUSY_DIRECTIONS])
    others = FreeSpace(int((before & quiet).sum()), int((on & quiet).sum()))
    return others if others.violation <= QUIET_SHARE else every  # false for NaN


def violation(
    views: tuple[DepthView, DepthView], clouds: tuple[Floats, Floats], i_from_j: Floats, scale: float = 1.0
) -> float:
    """The larger violation of both directions: points (N, 3) of j in view i, and of i in view j; NaN: unknown."""
    into_i = free_space(views[0], se3.transform(i_from_j, clouds[1]), scale).violation
    into_j = free_space(views[1], se3.transform(se3.inverse(i_from_j), clouds[0]), scale).violation
    return float(np.fmax(into_i, into_j))


def free_directions(points: Floats, normals: Floats) -> tuple[str, ...]:
    """The motions that surfaces (N, 3) with unit normals leave free, in words; empty where all six are constrained.

    Slippage (Gelfand and Guibas, SGP 2004): small eigenvalues of the point-to-plane normal matrix, at the centroid and
    for points of unit RMS radius. A plane leaves three, a sphere three, a cylinder two, a corridor one.
    """
    if len(points) < 6:
        return ("everything",)
    centred = points - points.mean(axis=0)
    rows = np.hstack([np.cross(centred, normals), normals])
    radius_m = float(np.sqrt((centred**2).sum(axis=1).mean()))
    scale = np.repeat([1 / max(radius_m, 1e-12), 1.0], 3)
    matrix = rows.T @ rows
    total = float(np.trace(matrix[3:, 3:]))
    if not total > 0:
        return ("everything",)
    values, vectors = np.linalg.eigh(scale[:, None] * matrix * scale / total)
    return tuple(named_direction(vector) for value, vector in zip(values, vectors.T, strict=True) if value < SLIPPAGE)
