"""One cloud from all frames: the mean point of each voxel. It needs no depth images: frames of points will do."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass
from scipy.sparse import csr_matrix

from hodge_pipeline import se3
from hodge_pipeline.errors import SourceError
from hodge_pipeline.fusion.views import Skipped, posed
from hodge_pipeline.stages import Advance, no_progress
from hodge_pipeline.types import Bools, Bytes, Camera, Floats, Floats32, Frame, Ints, Model, PointCloud
from hodge_pipeline.types.arrays import REACH, cells_of_keys, keys_of_cells, middles_in
from hodge_pipeline.types.text import counted

POINTS_AT_ONCE = 1 << 20
"""Of a frame, moved to the world: so a scan of any size takes some tens of megabytes."""

MAX_STEP = 0.05
"""Share of the depth: a larger step between neighbouring pixels is an occlusion edge, which has no normal."""

MERGE_AT = 1_000_000
"""Rows collected between two merges: each sorts all voxels."""
POSITION, COLOUR, NORMAL, COUNT = slice(0, 3), slice(3, 6), slice(6, 9), 9
"""Columns of the sums."""


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class CloudFuser:
    """Fuses depth images or point clouds into one down-sampled cloud."""

    voxel_m: float = Field(0.01, gt=0, description="metres: one point is kept for each cube of this side, their mean")
    stride: int = Field(2, ge=1, description="pixels: only each such row and column of a depth image is taken")
    min_depth_m: float = Field(0.2, ge=0, description="metres: measurements nearer than this are ignored")
    max_depth_m: float = Field(6.0, gt=0, description="metres: depth measurements beyond are ignored as too noisy")
    every: int = Field(1, ge=1, description="frames: only each such frame is fused; a long sequence needs fewer")
    max_points: int = Field(
        3_000_000,
        ge=1000,
        description="points of the cloud: where there would be more, voxel_m doubles; each takes 88 bytes, thrice "
        "while they are merged",
    )

    def fuse(self, frames: Sequence[Frame], world_from_cam: Floats, advance: Advance = no_progress) -> Model:
        """The cloud in the world frame, under the poses (N, 4, 4); its notes say what was left out.

        The same frames and poses give the same cloud. `SourceError` where no frame has a depth image or points.
        """
        if frames and not any(frame.read_points or (frame.read_depth and frame.camera) for frame in frames):
            raise SourceError(f"fusion: cloud: no frame, from {frames[0].frame_id} on, has a depth image or points")
        skipped, cloud, far = Skipped(), VoxelCloud(self.voxel_m, self.max_points), 0
        views = posed(frames, world_from_cam, self.every, skipped)
        for frame, pose in views:
            with skipped.unreadable(frame):
                far += self._add(cloud, frame, pose, skipped)
            advance(1)
        advance(len(frames) - len(views))
        points, normals, colours = cloud.points()
        return Model(
            name="cloud",
            points_in_world=points,
            normals_in_world=normals if normals.any() else None,
            colours=colours if colours.any() else None,
            notes=(*skipped.notes(), *self._notes(cloud, far)),
        )

    def _add(self, cloud: VoxelCloud, frame: Frame, world_from_cam: Floats, skipped: Skipped) -> int:
        view = self._view(frame, skipped)
        if view is None:
            skipped.add("neither depth image nor points", frame)
            return 0
        finite: Bools = np.asarray(np.isfinite(view.points_in_cam).all(axis=1))
        if not finite.any():
            skipped.add("no point within reach", frame)
        far = 0
        for start in range(0, len(finite), POINTS_AT_ONCE):
            part = slice(start, start + POINTS_AT_ONCE)
            good = finite[part]
            points = se3.transform(world_from_cam, view.points_in_cam[part][good].astype(float))
            normals = view.normals_in_cam
            turned = None if normals is None else normals[part][good] @ world_from_cam[:3, :3].T
            far += cloud.add(points, None if view.colours is None else view.colours[part][good], turned)
        return far

    def _view(self, frame: Frame, skipped: Skipped) -> PointCloud | None:
        if frame.read_depth and frame.camera:
            depth_m = frame.read_depth()
            colour = skipped.colour(frame)
            return depth_points(depth_m, colour, frame.camera, self.stride, self.min_depth_m, self.max_depth_m)
        return frame.read_points() if frame.read_points else None

    def _notes(self, cloud: VoxelCloud, far: int) -> list[str]:
        notes = []
        if cloud.voxel_m > self.voxel_m:
            notes.append(
                f"voxels of {cloud.voxel_m:g} m instead of {self.voxel_m:g} m: the scene would take more than "
                f"max_points = {self.max_points}"
            )
        if far:
            notes.append(f"{counted(far, 'point')} left out: more than a million voxels from the first frame")
        return notes


def depth_points(
    depth_m: Floats32, colour: Bytes | None, camera: Camera, stride: int, min_depth_m: float, max_depth_m: float
) -> PointCloud:
    """One point for each `stride`-th pixel whose depth is within the bounds, in the camera's axes.

    A normal faces the camera; it is 0 where the pixel lies at an edge or beside a missing measurement.
    """
    z = depth_m[::stride, ::stride].astype(float)
    v, u = np.mgrid[0 : depth_m.shape[0] : stride, 0 : depth_m.shape[1] : stride]
    grid = np.stack([(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z], axis=-1)
    valid = (z >= max(min_depth_m, 1e-6)) & (z <= max_depth_m)
    if colour is not None:
        colour = colour[middles_in(colour.shape[0], v, len(depth_m)), middles_in(colour.shape[1], u, depth_m.shape[1])]
    return PointCloud(
        points_in_cam=grid[valid].astype(np.float32),
        normals_in_cam=_normals(grid)[valid].astype(np.float32),
        colours=None if colour is None else colour[valid],
    )


def _normals(grid: Floats) -> Floats:
    """Unit normals (H, W, 3) by central differences; 0 at the border and at edges."""
    down, right = grid[2:, 1:-1] - grid[:-2, 1:-1], grid[1:-1, 2:] - grid[1:-1, :-2]
    z = grid[1:-1, 1:-1, 2]
    smooth = (np.abs(down[..., 2]) < 2 * MAX_STEP * z) & (np.abs(right[..., 2]) < 2 * MAX_STEP * z)
    normals = np.cross(down, right)
    length = np.linalg.norm(normals, axis=-1)
    away = np.einsum("hwk,hwk->hw", normals, grid[1:-1, 1:-1]) > 0
    out = np.zeros_like(grid)
    scale = np.where(away, -1.0, 1.0) / np.where(smooth & (length > 1e-12), length, np.inf)
    out[1:-1, 1:-1] = normals * scale[..., None]
    return out


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
        near = (np.abs(cells) < REACH - 1).all(axis=1)
        sums = np.zeros((len(cells), 10))
        sums[:, POSITION], sums[:, COUNT] = points_in_world - self.origin, 1
        if colours is not None:
            sums[:, COLOUR] = colours
        if normals_in_world is not None:
            sums[:, NORMAL] = normals_in_world
        self._waiting.append(_reduced(keys_of_cells(cells[near].astype(np.int64)), sums[near]))
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
            self._keys, self._sums = _reduced(keys_of_cells(cells_of_keys(self._keys) >> 1), self._sums)


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
