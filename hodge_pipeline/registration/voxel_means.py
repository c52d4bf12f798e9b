"""One averaged point for each occupied voxel, in parts: a scan of any size takes little memory beside itself."""

from __future__ import annotations

import numpy as np

from hodge_pipeline.types import Bytes, Floats, Floats32, Ints

POINTS_IN_PART = 1 << 20


def voxel_means(points: Floats32, colours: Bytes | None, voxel_m: float) -> tuple[Floats32, Bytes]:
    """The mean point and colour of every occupied voxel, ordered by voxel, so the same for any order of the input."""
    if not len(points):
        return np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8)
    columns = points.T  # numpy takes ten times as long along the first axis
    low = np.array([np.floor(column.min() / voxel_m) for column in columns], np.int64)
    counts = np.array([np.floor(column.max() / voxel_m) for column in columns], np.int64) - low + 1
    keys, sums = np.zeros(0, np.int64), np.zeros((0, 7))
    for start in range(0, len(points), POINTS_IN_PART):
        part = slice(start, start + POINTS_IN_PART)
        cells = np.floor(points[part] / voxel_m).astype(np.int64) - low
        own = np.ones((len(cells), 7))
        own[:, :3], own[:, 3:6] = points[part], 0 if colours is None else colours[part]
        found = _summed((cells[:, 0] * counts[1] + cells[:, 1]) * counts[2] + cells[:, 2], own)
        keys, sums = _summed(np.concatenate([keys, found[0]]), np.concatenate([sums, found[1]])) if start else found
    sizes = sums[:, 6:]
    return (sums[:, :3] / sizes).astype(np.float32), ((sums[:, 3:6] + sizes // 2) // sizes).astype(np.uint8)


def _summed(keys: Ints, values: Floats) -> tuple[Ints, Floats]:
    """The keys, ascending and each once, and the sums (K, c) of its rows of values (n, c)."""
    order = np.argsort(keys, kind="stable")
    starts = np.flatnonzero(np.diff(keys[order], prepend=-1))
    rank = np.empty(len(keys), np.int64)
    rank[order] = np.repeat(np.arange(len(starts)), np.diff(starts, append=len(keys)))
    sums = [np.bincount(rank, column, len(starts)) for column in values.T]
    return keys[order[starts]], np.stack(sums, axis=1, dtype=float)
