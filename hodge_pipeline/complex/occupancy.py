"""Which voxels of the world clouds enter: the cover whose nerve is the Čech complex, and whose overlaps are pairs."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from scipy.sparse import csr_matrix

from hodge_pipeline import se3
from hodge_pipeline.errors import GraphError
from hodge_pipeline.types import Floats, Ints, PointCloud
from hodge_pipeline.types.arrays import REACH, keys_of_cells


def voxels(points_in_world: Floats, voxel_m: float, origin: Ints) -> Ints:
    """The distinct voxels that points (N, 3) lie in, one int64 key each, ascending.

    The lattice is fixed to the world's origin: voxel (a, b, c) is [a, a + 1) x … times `voxel_m`, whatever the
    `origin` (3,) in voxels that the keys count from. `GraphError` where points are a million voxels from it.
    """
    cells = np.floor(points_in_world / voxel_m).astype(np.int64) - origin
    if len(cells) and (cells.min() < -REACH or cells.max() >= REACH):
        raise GraphError(
            f"the clouds spread over more than {2 * REACH} voxels of {voxel_m} m: the poses have diverged, "
            "or voxel_m is too small for this scene"
        )
    return np.unique(keys_of_cells(cells))


def voxel_occupancy(
    clouds: Iterable[PointCloud], world_from_cam: Floats, voxel_m: float, partners: Ints | None = None
) -> tuple[csr_matrix, Ints]:
    """The CSR matrix (N frames, M voxels) of int32, 1 where a frame has a point in a voxel that one of the `partners`
    (all frames where None are named) has a point in; and in how many voxels (N,) each frame has points at all.

    The row of a frame without points, or with a pose that is not finite, is empty.
    """
    finite = se3.has_pose(world_from_cam)
    origin = np.floor(world_from_cam[finite][:1, :3, 3].sum(axis=0) / voxel_m).astype(np.int64)
    nothing = np.zeros(0, np.int64)
    keys = [
        voxels(se3.transform(pose, cloud.points_in_cam.astype(float)), voxel_m, origin) if use else nothing
        for cloud, pose, use in zip(clouds, world_from_cam, finite, strict=True)
    ]
    named = keys if partners is None else [keys[row] for row in partners]
    names = np.append(np.unique(np.concatenate([nothing, *named])), np.iinfo(np.int64).max)  # above every key
    places = ((np.searchsorted(names, own), own) for own in keys)
    columns = [place[names[place] == own].astype(np.int32) for place, own in places]
    rows = np.concatenate([[0], np.cumsum([len(own) for own in columns])])
    entries = np.concatenate([np.zeros(0, np.int32), *columns])
    matrix = csr_matrix((np.ones(len(entries), np.int32), entries, rows), shape=(len(keys), len(names)))
    return matrix, np.array([len(own) for own in keys], np.int64)
