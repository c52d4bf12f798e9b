"""Local features of clouds (FPFH, Rusu et al. 2009) at one scale, and matches between two clouds."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from hodge_pipeline.types import Floats, Floats32, Ints, PointCloud

NORMAL_NEIGHBOURS = 30
FEATURE_NEIGHBOURS = 100
FEATURE_RADIUS_VOXELS = 5.0
"""Neighbours of a normal and of a feature, and radius of a feature: as in open3d's tutorial on global registration."""
FEWEST_POINTS = 20
BLOCK_ENTRIES = 4_000_000
"""Squared distances of features in memory at once, 16 MB."""
DIRECTION_STEP = 0.06
"""Side of a cell of directions, radians."""
DEEPER, LEVEL = 1.3, 1e-3
"""What lies further behind the nearest point of its cell is hidden; a slanted surface is not, nor a floor, which goes
farther within a cell the more level the view, in radians."""
SEEN_FROM_ORIGIN, FAR_RADII = 0.75, 3.0
"""Share of the points that must be visible from the origin for it to be the viewpoint, and its distance from the middle
in RMS radii of the cloud, at most.
"""
NEAREST_SEEN_M, NEAR_SHARE = 0.1, 0.05
"""Depth cameras and lasers measure nothing nearer: where more of the points are, the origin is no viewpoint, as in
scans of an object whose program counts from a zero of its own (the points of Stanford's bunny are 4 to 20 cm from it).
"""


@dataclass(frozen=True)
class DescribedCloud:
    """Points (N, 3), unit normals (N, 3) and FPFH features (N, 33) of a cloud down-sampled to one scale; the same cloud
    at coarser scales.
    """

    points: Floats
    normals: Floats
    features: Floats32
    coarser: tuple[DescribedCloud, ...] = ()

    def __len__(self) -> int:
        return len(self.points)

    @property
    def geometry(self) -> Any:
        """The open3d cloud."""
        return _geometry(self.points, self.normals)


def describe(cloud: PointCloud, voxel_m: float, most_points: float = np.inf) -> DescribedCloud:
    """The features of a cloud at a scale of `voxel_m`; none where it has fewer than 20 points at that scale, or more
    than `most_points`.

    Normals are of 30 neighbours and turned to the `viewpoint`, since features know one side from the other; a feature
    looks at what is within 5 voxels.
    """
    from hodge_pipeline.registration.one_thread import o3d

    points = np.asarray(cloud.points_in_cam, np.float64)
    coarse = _geometry(points[np.isfinite(points).all(axis=1)], None).voxel_down_sample(voxel_m)
    if not FEWEST_POINTS <= len(coarse.points) <= most_points:
        nothing = np.zeros((0, 3))
        return DescribedCloud(nothing, nothing, np.zeros((0, 33), np.float32))
    coarse.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(NORMAL_NEIGHBOURS))
    coarse.orient_normals_towards_camera_location(viewpoint(np.asarray(coarse.points)))
    search = o3d.geometry.KDTreeSearchParamHybrid(FEATURE_RADIUS_VOXELS * voxel_m, FEATURE_NEIGHBOURS)
    features = o3d.pipelines.registration.compute_fpfh_feature(coarse, search)  # type: ignore[call-arg]
    return DescribedCloud(
        np.asarray(coarse.points), np.asarray(coarse.normals), np.asarray(features.data).T.astype(np.float32)
    )


def viewpoint(points: Floats) -> Floats:
    """Where a cloud (N, 3) was seen from: its origin where little hides behind something else there, else its middle.

    The middle as well where the origin is far away, as in map coordinates, or nearer than any sensor measures.
    """
    middle = points.mean(axis=0)
    ranges = np.maximum(np.linalg.norm(points, axis=1), 1e-9)
    is_far = np.linalg.norm(middle) > FAR_RADII * np.sqrt(((points - middle) ** 2).sum(axis=1).mean())
    if is_far or (ranges < NEAREST_SEEN_M).mean() > NEAR_SHARE:
        return np.asarray(middle)
    up = np.arcsin(np.clip(points[:, 2] / ranges, -1, 1))
    turn = np.arctan2(points[:, 1], points[:, 0])
    cells = np.floor(np.stack([up, turn], axis=1) / DIRECTION_STEP).astype(np.int64)
    _, cell = np.unique(cells, axis=0, return_inverse=True)
    nearest = np.full(int(cell.max()) + 1, np.inf)
    np.minimum.at(nearest, cell.reshape(-1), ranges)
    low = np.maximum(np.abs(up), LEVEL)
    floor_ratio = np.sin(np.minimum(low + DIRECTION_STEP, np.pi / 2)) / np.sin(low)  # a floor over one cell
    seen = ranges <= nearest[cell.reshape(-1)] * np.maximum(DEEPER, floor_ratio)
    return np.zeros(3) if seen.mean() >= SEEN_FROM_ORIGIN else np.asarray(middle)


def mutual_matches(target: DescribedCloud, source: DescribedCloud) -> Ints:
    """Rows (M, 2) of target and source points whose features are each other's nearest, the nearest first."""
    if not len(target) or not len(source):
        return np.zeros((0, 2), np.int64)
    # |s|² − 2 s·t + |t|² of all pairs as one product
    ones_i, ones_j = np.ones((len(target), 1), np.float32), np.ones((len(source), 1), np.float32)
    middle = target.features.mean(axis=0)  # without it float32 rounds away what nearly equal features differ by
    f_i, f_j = target.features - middle, source.features - middle
    columns = np.hstack([f_i, ones_i, (f_i**2).sum(axis=1, keepdims=True)]).T
    queries = np.hstack([-2 * f_j, (f_j**2).sum(axis=1, keepdims=True), ones_j])
    to_source, nearest, distance = np.full(len(target), np.inf, np.float32), [], []
    step = max(1, BLOCK_ENTRIES // len(target))
    for start in range(0, len(source), step):
        squared = queries[start : start + step] @ columns
        nearest.append(squared.argmin(axis=1))
        distance.append(squared.min(axis=1))
        np.minimum(to_source, squared.min(axis=0), out=to_source)
    rows_i, apart = np.concatenate(nearest), np.concatenate(distance)
    rows = np.flatnonzero(apart == to_source[rows_i])
    rows = np.sort(rows[np.unique(rows_i[rows], return_index=True)[1]])  # the first of equals
    rows = rows[np.argsort(apart[rows], kind="stable")]
    return np.stack([rows_i[rows], rows], axis=1).astype(np.int64)


def _geometry(points: Floats, normals: Floats | None) -> Any:
    from hodge_pipeline.registration.one_thread import o3d

    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    if normals is not None:
        cloud.normals = o3d.utility.Vector3dVector(normals)
    return cloud
