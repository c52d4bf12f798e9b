"""A sparse grid of truncated signed distances: open3d's VoxelBlockGrid within a bound of memory."""

from __future__ import annotations

from typing import Any

import numpy as np
import open3d as o3d

from hodge_pipeline import se3
from hodge_pipeline.types import Bytes, Camera, Floats, Floats32

BLOCK_SIDE = 16
BYTES_A_VOXEL = 4 + 4 + 12 + 16
"""Distance, weight, colour, and the vertex index that the extraction adds."""
GROWTH_COPIES = 3
"""The old blocks are alive while the twice as many new ones are filled."""
FIRST_BLOCKS = 1000
GREY = 128
TOUCH_STRIDE = 4
"""Of a depth image open3d takes each fourth row and column to find the blocks that it touches."""


class GridFull(Exception):
    """The next frame would take the grid past its bound. Internal: the fuser starts again with coarser voxels."""


def blocks_within(memory_limit_mb: float) -> int:
    """How many blocks a grid may have, so that it stays within the limit even while it grows."""
    return max(1, int(memory_limit_mb * 1e6 / (BLOCK_SIDE**3 * BYTES_A_VOXEL * GROWTH_COPIES)))


class BlockGrid:
    """Integrates depth images; `max_blocks` bounds it, `GridFull` is raised before it is passed.

    It holds colours for all views or, without `colour`, for none; `views` of them were added, `coloured` with an image.
    """

    def __init__(
        self, voxel_m: float, truncation_voxels: float, max_depth_m: float, max_blocks: int, colour: bool
    ) -> None:
        self.truncation_voxels, self.max_depth_m, self.max_blocks = truncation_voxels, max_depth_m, max_blocks
        self.colour, self.views, self.coloured = colour, 0, 0
        float32 = o3d.core.float32
        self._grid = o3d.t.geometry.VoxelBlockGrid(
            attr_names=("tsdf", "weight", "color"),
            attr_dtypes=(float32, float32, float32),
            attr_channels=[o3d.core.SizeVector([count]) for count in (1, 1, 3)],
            voxel_size=voxel_m,
            block_resolution=BLOCK_SIDE,
            block_count=min(FIRST_BLOCKS, max_blocks),
        )

    def __len__(self) -> int:
        return int(self._grid.hashmap().size())

    def integrate(self, depth_m: Floats32, colour: Bytes | None, camera: Camera, world_from_cam: Floats) -> bool:
        """Add one view: depth (H, W), 0 where there is none; colour (h, w, 3) of the same field of view, or none: grey.

        False where no depth is within reach: there was nothing to add.
        """
        if not self._reaches(depth_m):
            return False
        depth = o3d.t.geometry.Image(_tensor(depth_m, np.float32))
        pose, reach = _tensor(se3.inverse(world_from_cam), np.float64), (self.max_depth_m, self.truncation_voxels)
        blocks = self._grid.compute_unique_block_coordinates(
            depth,
            _tensor(camera.matrix, np.float64),
            pose,
            depth_scale=1.0,
            depth_max=reach[0],
            trunc_voxel_multiplier=reach[1],
        )
        self._make_room(len(blocks))
        matrix = _floor_matrix(camera, depth_m.shape, depth_m.shape)
        self.views, self.coloured = self.views + 1, self.coloured + (colour is not None)
        if not self.colour:
            self._grid.integrate(blocks, depth, matrix, pose, 1.0, *reach)
        else:
            colour = np.full((*depth_m.shape, 3), GREY, np.uint8) if colour is None else colour
            image = o3d.t.geometry.Image(_tensor(colour, np.float32))
            colour_matrix = _floor_matrix(camera, depth_m.shape, colour.shape)
            self._grid.integrate(blocks, depth, image, matrix, colour_matrix, pose, 1.0, *reach)
        return True

    def _reaches(self, depth_m: Floats32) -> bool:
        """Whether the pixels that open3d looks at to find blocks hold a depth; it raises an error where none does."""
        height, width = (side // TOUCH_STRIDE * TOUCH_STRIDE for side in depth_m.shape)
        seen = depth_m[:height:TOUCH_STRIDE, :width:TOUCH_STRIDE]
        return bool(((seen > 0) & (seen < self.max_depth_m)).any())

    def _make_room(self, blocks: int) -> None:
        needed = len(self) + blocks
        if needed > self.max_blocks:
            raise GridFull
        capacity = int(self._grid.hashmap().capacity())
        if needed > capacity:
            self._grid.hashmap().reserve(min(max(needed, 2 * capacity), self.max_blocks))

    def mesh(self, min_weight: float) -> tuple[Floats32, Floats32, Bytes, Any]:
        """Vertices (V, 3), normals, colours and triangles (T, 3) of the surface seen more than `min_weight` times.

        They are in an order of their own, by x, y, z: the one in which the grid gives them changes from run to run.
        """
        if len(self) == 0:
            nothing = np.zeros((0, 3), np.float32)
            return nothing, nothing, nothing.astype(np.uint8), nothing.astype(np.int32)
        mesh = self._grid.extract_triangle_mesh(min_weight)
        points, normals = mesh.vertex.positions.numpy(), mesh.vertex.normals.numpy()
        colours = np.rint(np.clip(mesh.vertex.colors.numpy(), 0, 255)).astype(np.uint8)
        order = np.lexsort(points.T[::-1])
        rank = np.empty(len(order), np.int32)
        rank[order] = np.arange(len(order), dtype=np.int32)
        return points[order], normals[order], colours[order], _sorted_triangles(rank[mesh.triangle.indices.numpy()])


def _tensor(values: Any, kind: Any) -> Any:
    return o3d.core.Tensor.from_numpy(np.ascontiguousarray(values, kind))


def _sorted_triangles(triangles: Any) -> Any:
    """The same triangles, each turned to begin with its least vertex, in ascending order."""
    turns = (np.argmin(triangles, axis=1)[:, None] + np.arange(3)) % 3
    turned = np.take_along_axis(triangles, turns, axis=1)
    return turned[np.lexsort(turned.T[::-1])]


def _floor_matrix(camera: Camera, depth_shape: tuple[int, ...], image_shape: tuple[int, ...]) -> Any:
    """K for an image of this shape and the depth image's field of view, with pixel centres at halves.

    open3d finds the pixel of a voxel by rounding down, so with pixel centres at whole numbers every surface would be
    fused half a pixel aside: on a wall seen aslant that is a bias in depth.
    """
    centre = np.array([[0.0, 0.0, 0.5], [0.0, 0.0, 0.5], [0.0, 0.0, 0.0]])
    scale = np.diag([image_shape[1] / depth_shape[1], image_shape[0] / depth_shape[0], 1.0])
    return _tensor(scale @ (camera.matrix + centre), np.float64)
