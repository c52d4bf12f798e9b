"""A sparse grid of truncated signed distances: open3d's VoxelBlockGrid within a bound of memory."""

from __future__ import annotations

from typing import Any

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.fusion.boxes import Box
from hodge_pipeline.fusion.mesh import Mesh
from hodge_pipeline.lean_open3d import o3d
from hodge_pipeline.types import Bytes, Camera, Floats, Floats32, Ints

BLOCK_SIDE = 8
VALUES = {"tsdf": 1, "weight": 1, "color": 3}
"""Attributes of a voxel by open3d's names, with the number of channels."""
BYTES_A_VOXEL = 4 + 4 + 12 + 16
"""Distance, weight, colour, and the vertex index that the mesh extraction adds."""
GROWTH_COPIES = 3
"""Memory while the grid doubles, in sizes of the old one: the old blocks and twice as many new ones."""
FIRST_BLOCKS = 8000
"""147 MB, from which the grid doubles as it fills."""
GREY = 128
"""Grey level of voxels in a block that no image has coloured."""
COLOUR_OFFSET = 1
"""Added to colours in the grid, so that 0 means no colour and not black."""
COLOUR_SCALE = 255.0
"""By which open3d multiplies the colours of a float image in a grid, and divides those of a mesh."""
BLOCKS_AT_ONCE = 1000
"""18 MB of voxels, which are copied to be looked at."""
TOUCH_STRIDE = 4
"""open3d samples every fourth row and column of a depth image to find the blocks that it touches."""


class GridFull(Exception):
    """The next frame would take the grid past `max_blocks`: the fuser starts again, box by box."""


def blocks_within(memory_limit_mb: float) -> int:
    """How many blocks a grid may have, so that it stays within the limit even while it grows."""
    return max(1, int(memory_limit_mb * 1e6 / (BLOCK_SIDE**3 * BYTES_A_VOXEL * GROWTH_COPIES)))


TRUNCATION_VOXELS = 4.0
"""Truncation distance in voxels; must exceed depth noise and drift."""


class BlockGrid:
    """A TSDF of at most `max_blocks` blocks, with colours if `colour`; `GridFull` is raised before it grows larger.

    `views` counts the views added, `coloured` those of them with an image, which must come first: open3d divides the
    colour of a voxel by all its views. With a `box` it holds only the blocks in the box and those next to it, which the
    surface at its faces needs.
    """

    def __init__(
        self,
        voxel_m: float,
        max_depth_m: float,
        max_blocks: int,
        colour: bool,
        box: Box | None = None,
    ) -> None:
        self.max_depth_m, self.max_blocks = max_depth_m, max_blocks
        self.voxel_m, self.box = voxel_m, box
        self.colour, self.views, self.coloured = colour, 0, 0
        self._grid = self._empty(min(FIRST_BLOCKS, max_blocks))

    def __len__(self) -> int:
        return int(self._grid.hashmap().size())

    def integrate(self, depth_m: Floats32, colour: Bytes | None, camera: Camera, world_from_cam: Floats) -> bool:
        """Add one view: depth (H, W) in metres, 0 where there is none; colour (h, w, 3) of the same field of view.

        False where no depth is within `max_depth_m`. Raises `GridFull`.
        """
        if not self._reaches(depth_m):
            return False
        depth = o3d.t.geometry.Image(_tensor(depth_m, np.float32))
        pose, reach = _tensor(se3.inverse(world_from_cam), np.float64), (self.max_depth_m, TRUNCATION_VOXELS)
        blocks = self._touched(depth, camera, pose)
        if self.box is not None:
            blocks = blocks[_tensor(self.box.around.holds(blocks.numpy()), bool)]
        if not len(blocks):
            return True
        self._make_room(len(blocks))
        matrix = _floor_matrix(camera, depth_m.shape, depth_m.shape)
        self.views, self.coloured = self.views + 1, self.coloured + (colour is not None)
        if not self.colour or colour is None:
            self._grid.integrate(blocks, depth, matrix, pose, 1.0, *reach)
        else:
            image = o3d.t.geometry.Image(_tensor(np.add(colour, COLOUR_OFFSET, dtype=np.float32), np.float32))
            colour_matrix = _floor_matrix(camera, depth_m.shape, colour.shape)
            self._grid.integrate(blocks, depth, image, matrix, colour_matrix, pose, 1.0, *reach)
        return True

    def touched(self, depth_m: Floats32, camera: Camera, world_from_cam: Floats) -> Ints:
        """The blocks (M, 3) that a view would be added to."""
        if not self._reaches(depth_m):
            return np.zeros((0, 3), np.int64)
        depth = o3d.t.geometry.Image(_tensor(depth_m, np.float32))
        blocks = self._touched(depth, camera, _tensor(se3.inverse(world_from_cam), np.float64))
        return np.asarray(blocks.numpy(), np.int64)

    def _touched(self, depth: Any, camera: Camera, cam_from_world: Any) -> Any:
        return self._grid.compute_unique_block_coordinates(
            depth,
            _tensor(camera.matrix, np.float64),
            cam_from_world,
            depth_scale=1.0,
            depth_max=self.max_depth_m,
            trunc_voxel_multiplier=TRUNCATION_VOXELS,
        )

    def _reaches(self, depth_m: Floats32) -> bool:
        """Whether the pixels that open3d looks at to find blocks hold a depth; it raises an error where none does."""
        height, width = (side // TOUCH_STRIDE * TOUCH_STRIDE for side in depth_m.shape)
        seen = depth_m[:height:TOUCH_STRIDE, :width:TOUCH_STRIDE]
        return bool(((seen > 0) & (seen < self.max_depth_m)).any())

    def _make_room(self, blocks: int) -> None:
        needed = len(self) + blocks
        if needed > self.max_blocks:
            raise GridFull
        old, capacity = self._grid, int(self._grid.hashmap().capacity())
        if needed <= capacity:
            return
        self._grid = self._empty(min(max(needed, 2 * capacity), self.max_blocks))
        rows = old.hashmap().active_buf_indices().to(o3d.core.int64)
        new_rows, _ = self._grid.hashmap().activate(old.hashmap().key_tensor()[rows])
        for name in VALUES:  # open3d's own reserve takes a millisecond a block
            values, new_values = old.attribute(name).numpy(), self._grid.attribute(name).numpy()
            for row, new_row in zip(rows.numpy().tolist(), new_rows.numpy().tolist(), strict=True):
                new_values[new_row] = values[row]

    def _empty(self, blocks: int) -> Any:
        """An empty grid with room for so many blocks."""
        return o3d.t.geometry.VoxelBlockGrid(
            attr_names=tuple(VALUES),
            attr_dtypes=(o3d.core.float32,) * len(VALUES),
            attr_channels=[o3d.core.SizeVector([count]) for count in VALUES.values()],
            voxel_size=self.voxel_m,
            block_resolution=BLOCK_SIDE,
            block_count=blocks,
        )

    def mesh(self, min_weight: float) -> Mesh:
        """The surface seen more than `min_weight` times; with a box, its part inside the box."""
        if len(self) == 0:
            return Mesh.joined([])
        if self.colour:
            self._colour_the_rest()
        raw = self._grid.extract_triangle_mesh(min_weight)
        points, normals = raw.vertex.positions.numpy(), raw.vertex.normals.numpy()
        colours = np.rint(np.clip(raw.vertex.colors.numpy() - COLOUR_OFFSET, 0, 255)).astype(np.uint8)
        mesh = Mesh(points, normals, colours, raw.triangle.indices.numpy())
        if self.box is not None:
            middles = points[mesh.triangles].mean(axis=1, dtype=float)
            mesh = mesh.with_triangles(self.box.holds(np.floor(middles / (self.voxel_m * BLOCK_SIDE))))
        return mesh.ordered()

    def _colour_the_rest(self) -> None:
        """Give voxels that no image has coloured the mean colour of their block."""
        colours, weights = (self._grid.attribute(name).numpy() for name in ("color", "weight"))
        rows = self._grid.hashmap().active_buf_indices().numpy().astype(np.int64)
        for part in np.split(rows, range(BLOCKS_AT_ONCE, len(rows), BLOCKS_AT_ONCE)):
            coloured = colours[part, ..., 0] > 0
            bare = (weights[part, ..., 0] > 0) & ~coloured
            for block in np.flatnonzero(bare.any(axis=(1, 2, 3))).tolist():
                own = colours[part[block]]
                known = own[coloured[block]]
                own[bare[block]] = known.mean(axis=0) if len(known) else COLOUR_SCALE * (GREY + COLOUR_OFFSET)


def _tensor(values: Any, kind: Any) -> Any:
    return o3d.core.Tensor.from_numpy(np.ascontiguousarray(values, kind))


def _floor_matrix(camera: Camera, depth_shape: tuple[int, ...], image_shape: tuple[int, ...]) -> Any:
    """K for an image of this shape and the depth image's field of view, with pixel centres at halves.

    open3d finds the pixel of a voxel by rounding down, so with pixel centres at whole numbers every surface would be
    fused half a pixel aside: on a wall seen aslant that is a bias in depth.
    """
    centre = np.array([[0.0, 0.0, 0.5], [0.0, 0.0, 0.5], [0.0, 0.0, 0.0]])
    scale = np.diag([image_shape[1] / depth_shape[1], image_shape[0] / depth_shape[0], 1.0])
    return _tensor(scale @ (camera.matrix + centre), np.float64)
