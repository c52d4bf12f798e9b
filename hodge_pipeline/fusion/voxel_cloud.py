"""A cloud that grows: the mean of all points in each voxel, with colour and normal, within a bound on its size."""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_matrix

from hodge_pipeline.types import Bytes, Floats, Floats32, Ints

AXIS_BITS = 21
HALF = 1 << (AXIS_BITS - 1)
MERGE_AT = 1_000_000
"""Rows that wait before they are merged: a merge sorts all voxels, so it must be rare."""
POSITION, COLOUR, NORMAL, COUNT = slice(0, 3), slice(3, 6), slice(6, 9), 9


class VoxelCloud:
    """Sums of position, colour, normal and count for each voxel, in two arrays sorted by voxel.

    Where there are more than `max_points` voxels, their side doubles until there are not.
    """

    def __init__(self, voxel_m: float, max_points: int) -> None:
        self.voxel_m, self.max_points = voxel_m, max_points
        self.origin: Floats | None = None
        self._keys, self._sums = np.zeros(0, np.int64), np.zeros((0, 10))
        self._waiting: list[tuple[Ints, Floats]] = []

    def add(self, points_in_world: Floats, colours: Bytes | None, normals_in_world: Floats | None) -> int:
        """Add points (N, 3); gives how many lie more than a million voxels from the first ones, and are left out."""
        if len(points_in_world) == 0:
            return 0
        if self.origin is None:
            self.origin = np.floor(points_in_world.mean(axis=0))
        cells = np.floor((points_in_world - self.origin) / self.voxel_m)
        near = (np.abs(cells) < HALF - 1).all(axis=1)
        sums = np.zeros((len(cells), 10))
        sums[:, POSITION], sums[:, COUNT] = points_in_world - self.origin, 1
        if colours is not None:
            sums[:, COLOUR] = colours
        if normals_in_world is not None:
            sums[:, NORMAL] = normals_in_world
        self._waiting.append(_reduced(_packed(cells[near].astype(np.int64)), sums[near]))
        if sum(len(keys) for keys, _ in self._waiting) > MERGE_AT:
            self._merge()
        return int((~near).sum())

    def points(self) -> tuple[Floats32, Floats32, Bytes]:
        """The mean position, unit normal (0 where none was given) and colour of each voxel."""
        self._merge()
        sums = self._sums
        count = sums[:, COUNT, None]
        origin = np.zeros(3) if self.origin is None else self.origin
        length = np.linalg.norm(sums[:, NORMAL], axis=1, keepdims=True)
        normals = sums[:, NORMAL] / np.where(length > 1e-9, length, np.inf)
        colours = np.rint(sums[:, COLOUR] / count).astype(np.uint8)
        return (sums[:, POSITION] / count + origin).astype(np.float32), normals.astype(np.float32), colours

    def _merge(self) -> None:
        self._keys, self._sums = _reduced(
            np.concatenate([self._keys, *(keys for keys, _ in self._waiting)]),
            np.concatenate([self._sums, *(sums for _, sums in self._waiting)]),
        )
        self._waiting = []
        while len(self._keys) > self.max_points:
            self.voxel_m *= 2
            self._keys, self._sums = _reduced(_packed(_unpacked(self._keys) >> 1), self._sums)


def _packed(cells: Ints) -> Ints:
    shifted = cells + HALF
    return np.asarray((shifted[:, 0] << 2 * AXIS_BITS) | (shifted[:, 1] << AXIS_BITS) | shifted[:, 2])


def _unpacked(keys: Ints) -> Ints:
    mask = (1 << AXIS_BITS) - 1
    return np.stack([keys >> 2 * AXIS_BITS, (keys >> AXIS_BITS) & mask, keys & mask], axis=1) - HALF


def _reduced(keys: Ints, sums: Floats) -> tuple[Ints, Floats]:
    """One row for each key, ascending: the sum of its rows."""
    if len(keys) == 0:
        return keys, sums
    order = np.argsort(keys, kind="stable")
    keys = keys[order]
    starts = np.flatnonzero(np.concatenate([[True], keys[1:] != keys[:-1]]))
    # A product with a sparse matrix of ones sums each run of rows where they lie, without a sorted copy of them.
    runs = csr_matrix((np.ones(len(order)), order, np.append(starts, len(order))), shape=(len(starts), len(order)))
    return keys[starts], np.asarray(runs @ sums)
