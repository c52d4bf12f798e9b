"""One averaged point for each occupied voxel, in parts: a scan of any size takes little memory beside itself."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from hodge_pipeline.types import Bytes, Floats, Floats32, Ints

POINTS_IN_PART = 1 << 20


class _Sums(NamedTuple):
    """Keys of voxels, ascending; the sums of their points and colours, and how many there are."""

    keys: Ints
    points: Floats
    colours: Ints
    counts: Ints


def voxel_means(points: Floats32, colours: Bytes | None, voxel_m: float) -> tuple[Floats32, Bytes]:
    """The mean point and colour of every occupied voxel, ordered by voxel, so the same for any order of the input."""
    if not len(points):
        return np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8)
    low = np.floor(points.min(axis=0) / voxel_m).astype(np.int64)
    counts = np.floor(points.max(axis=0) / voxel_m).astype(np.int64) - low + 1
    sums: _Sums | None = None
    for start in range(0, len(points), POINTS_IN_PART):
        part = slice(start, start + POINTS_IN_PART)
        cells = np.floor(points[part] / voxel_m).astype(np.int64) - low
        keys = (cells[:, 0] * counts[1] + cells[:, 1]) * counts[2] + cells[:, 2]
        own = np.zeros((len(keys), 3), np.uint8) if colours is None else colours[part]
        found = _summed(_Sums(keys, points[part], own, np.ones(len(keys), np.int64)))  # type: ignore[arg-type]
        sums = found if sums is None else _summed(_both(sums, found))
    assert sums is not None
    sizes = sums.counts[:, None]
    means = (sums.points / sizes).astype(np.float32)
    return means, ((sums.colours + sizes // 2) // sizes).astype(np.uint8)


def _both(first: _Sums, second: _Sums) -> _Sums:
    columns: list[Any] = [np.concatenate(pair) for pair in zip(first, second, strict=True)]
    return _Sums(*columns)


def _summed(rows: _Sums) -> _Sums:
    order = np.argsort(rows.keys, kind="stable")
    keys = rows.keys[order]
    starts = np.flatnonzero(np.diff(keys, prepend=-1))
    return _Sums(
        keys[starts],
        np.add.reduceat(rows.points[order], starts, axis=0, dtype=np.float64),
        np.add.reduceat(rows.colours[order], starts, axis=0, dtype=np.int64),
        np.add.reduceat(rows.counts[order], starts),
    )
