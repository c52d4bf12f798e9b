"""One averaged point for each occupied voxel, in parts: a scan of any size takes little memory beside itself."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from hodge_pipeline.types import Bytes, Floats, Floats32, Ints

POINTS_IN_PART = 1 << 20
"""Points summed at once: their keys and columns take some 100 MB."""
_Sums: TypeAlias = tuple[Ints, list[Floats]]
"""Keys of voxels (K,), and columns (K,) of sums."""


def voxel_means(points: Floats32, colours: Bytes | None, voxel_m: float) -> tuple[Floats32, Bytes]:
    """The mean point and colour of every occupied voxel, ordered by voxel, so the same for any order of the input."""
    if not len(points):
        return np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8)
    # numpy takes ten times as long along the first axis
    columns = [np.ascontiguousarray(column) for column in points.T]
    low = [int(np.floor(column.min() / voxel_m)) for column in columns]
    counts = [int(np.floor(column.max() / voxel_m)) - least + 1 for column, least in zip(columns, low, strict=True)]
    keys, sums = np.zeros(0, np.int64), [np.zeros(0)] * 7
    for start in range(0, len(points), POINTS_IN_PART):
        part = slice(start, start + POINTS_IN_PART)
        x, y, z = (
            np.floor(column[part] / voxel_m).astype(np.int64) - least
            for column, least in zip(columns, low, strict=True)
        )
        shades = [np.broadcast_to(0.0, len(x))] * 3 if colours is None else list(colours[part].T)
        own = [*(column[part] for column in columns), *shades, np.broadcast_to(1.0, len(x))]
        found = _summed((x * counts[1] + y) * counts[2] + z, own)
        keys, sums = _summed(*_joined((keys, sums), found)) if start else found
    sizes = sums[6]
    means = np.stack([column / sizes for column in sums[:3]], axis=1, dtype=np.float32, casting="same_kind")
    return means, np.stack([(column + sizes // 2) // sizes for column in sums[3:6]], axis=1).astype(np.uint8)


def _summed(keys: Ints, columns: Sequence[NDArray[Any]]) -> _Sums:
    """The keys, ascending and each once, and the sums (K,) of its rows of each column (n,)."""
    order = np.argsort(keys, kind="stable")
    starts = np.flatnonzero(np.diff(keys[order], prepend=-1))
    rank = np.empty(len(keys), np.int64)
    rank[order] = np.repeat(np.arange(len(starts)), np.diff(starts, append=len(keys)))
    return keys[order[starts]], [np.bincount(rank, column, len(starts)).astype(float) for column in columns]


def _joined(one: _Sums, other: _Sums) -> _Sums:
    keys = np.concatenate([one[0], other[0]])
    return keys, [np.concatenate(pair) for pair in zip(one[1], other[1], strict=True)]
