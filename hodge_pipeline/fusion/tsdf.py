"""A coloured mesh from depth images: truncated signed distances averaged in a sparse grid, then marching cubes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias

import numpy as np
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from hodge_pipeline.errors import SourceError
from hodge_pipeline.fusion.block_grid import BlockGrid, GridFull, blocks_within
from hodge_pipeline.fusion.boxes import Box, boxes_of
from hodge_pipeline.fusion.mesh import Mesh
from hodge_pipeline.fusion.views import Skipped, posed
from hodge_pipeline.stages import Advance, no_progress
from hodge_pipeline.types import Floats, Frame, Ints, Model

BYTES_A_VERTEX = 150
"""Position, normal, colour and two triangles, three times over while the mesh is sorted."""
MOST_BETWEEN, FEWEST_COLOURED = 3, 30
"""Every third view is fused with colour, more of fewer than 90: colour is half of the cost of a view."""
Views: TypeAlias = list[tuple[Frame, Floats, bool]]
"""Frame, pose, and whether it is fused with colour."""
_Made: TypeAlias = tuple[Mesh, float, bool]
"""A mesh, the `min_weight` that it was extracted with, and whether any view had colour."""


class _Progress:
    """Reports each view once, however often the passes over the views read it."""

    def __init__(self, advance: Advance) -> None:
        self._advance, self.told = advance, 0

    def reached(self, views: int) -> None:
        """The first `views` of them have been read."""
        if views > self.told:
            self._advance(views - self.told)
            self.told = views


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class TsdfFuser:
    """Fuses depth images into a mesh."""

    voxel_m: float = Field(
        0.02, gt=0, description="metres: side of a voxel; 0.02 is near the noise of a depth camera in a room"
    )
    max_depth_m: float = Field(6.0, gt=0, description="metres: measurements beyond are ignored as too noisy")
    min_weight: float = Field(
        3.0,
        ge=0,
        description="frames: a surface that no more than so many have seen is left out, as flying pixels are; where no "
        "more are fused, all of them must have seen it",
    )
    every: int = Field(1, ge=1, description="frames: only each such frame is fused; a long sequence needs fewer")
    min_motion_m: float = Field(
        0.0,
        ge=0,
        description="metres, and radians at one metre: a frame that moved less since the last one fused is left out "
        "and not read; at frame rate 0.05 leaves out two of three, which show the same from the same side",
    )
    colour: bool = Field(
        True, description="colour the mesh, by every third view; without it fusion is a quarter faster"
    )
    memory_limit_mb: float = Field(
        2000.0,
        ge=50,
        description="megabytes for the grid while it grows and is meshed, and again for the mesh: a scene whose grid "
        "needs more is fused in boxes, one after the other; one whose mesh does, with voxels twice as large",
    )

    def fuse(self, frames: Sequence[Frame], world_from_cam: Floats, advance: Advance = no_progress) -> Model:
        """The mesh in the world frame, under the poses (N, 4, 4); its notes say what was left out.

        The same frames and poses give the same mesh. `SourceError` where no frame has a depth image.
        """
        if frames and not any(frame.read_depth and frame.camera for frame in frames):
            raise SourceError(
                f"fusion: tsdf: no frame, from {frames[0].frame_id} on, has a depth image: take fusion: cloud"
            )
        skipped, voxel_m, made = Skipped(), self.voxel_m, None
        views = _coloured_first(posed(frames, world_from_cam, self.every, skipped, self.min_motion_m))
        progress = _Progress(advance)
        while made is None:
            made = self._made(views, voxel_m, skipped, progress)
            voxel_m *= 2 if made is None else 1
        advance(len(frames) - progress.told)
        mesh, min_weight, coloured = made
        return Model(
            name="mesh",
            points_in_world=mesh.points,
            normals_in_world=mesh.normals,
            colours=mesh.colours if coloured else None,
            triangles=mesh.triangles,
            notes=(
                *skipped.notes(),
                *self._notes(voxel_m, len(mesh.triangles), min_weight),
                *self._thinned(len(views), len(frames)),
            ),
        )

    def _made(self, views: Views, voxel_m: float, skipped: Skipped, progress: _Progress) -> _Made | None:
        """The mesh, fused box by box where one grid cannot hold it; None where it would exceed the memory limit."""
        grid = self._grid(voxel_m, views, None)
        try:
            self._integrate(grid, views, skipped, progress)
        except GridFull:
            return self._made_in_boxes(views, voxel_m, skipped, progress)
        min_weight = self._min_weight(grid.views)
        return grid.mesh(min_weight), min_weight, grid.coloured > 0

    def _made_in_boxes(self, views: Views, voxel_m: float, skipped: Skipped, progress: _Progress) -> _Made | None:
        """The mesh as of `_made`, from boxes of space one after the other, each fused from the views that see it."""
        blocks, spans = self._touched(self._grid(voxel_m, views, None), views, skipped, progress)
        min_weight = self._min_weight(int((spans[:, 0] <= spans[:, 1]).all(axis=1).sum()))
        parts, vertices, coloured = [], 0, False
        for box in boxes_of(blocks, blocks_within(self.memory_limit_mb) // 2):
            grid = self._grid(voxel_m, views, box)
            own = np.flatnonzero(box.around.meets(spans))
            self._integrate(grid, [views[row] for row in own.tolist()], skipped, progress)
            parts.append(grid.mesh(min_weight))
            vertices, coloured = vertices + len(parts[-1].points), coloured or grid.coloured > 0
            if vertices * BYTES_A_VERTEX > self.memory_limit_mb * 1e6:
                return None
        return Mesh.joined(parts), min_weight, coloured

    def _min_weight(self, views: int) -> float:
        return min(self.min_weight, max(views - 1.0, 0.0))

    def _grid(self, voxel_m: float, views: Views, box: Box | None) -> BlockGrid:
        colour = self.colour and any(frame.read_colour for frame, *_ in views)
        limit = blocks_within(self.memory_limit_mb)
        return BlockGrid(voxel_m, self.max_depth_m, limit, colour, box)

    def _touched(self, grid: BlockGrid, views: Views, skipped: Skipped, progress: _Progress) -> tuple[Ints, Ints]:
        """All blocks (M, 3), and each view's least and largest block (V, 2, 3), least above largest if it has none."""
        blocks: set[tuple[int, int, int]] = set()
        spans = np.broadcast_to(np.array([[1, 1, 1], [0, 0, 0]]), (len(views), 2, 3)).copy()
        for row, (frame, pose, _) in enumerate(views):
            with skipped.unreadable(frame):
                if frame.camera is not None and frame.read_depth is not None:
                    own = grid.touched(frame.read_depth(), frame.camera, pose)
                    blocks.update(map(tuple, own.tolist()))
                    spans[row] = [own.min(axis=0), own.max(axis=0)] if len(own) else spans[row]
            progress.reached(row + 1)
        return np.array(sorted(blocks), np.int64).reshape(-1, 3), spans

    def _integrate(self, grid: BlockGrid, views: Views, skipped: Skipped, progress: _Progress) -> None:
        views, count = list(views), len(views)
        for row, (frame, pose, is_coloured) in enumerate(views):  # grows, see below
            if frame.camera is None or frame.read_depth is None:
                skipped.add("no depth image", frame)
                continue
            colour = skipped.colour(frame) if grid.colour and is_coloured else None
            if grid.colour and is_coloured and colour is None:  # it must come after those with colour
                views.append((frame, pose, False))
                continue
            with skipped.unreadable(frame):
                depth_m = frame.read_depth()
                if not grid.integrate(depth_m, colour, frame.camera, pose):
                    skipped.add(f"no depth within max_depth_m = {self.max_depth_m:g}", frame)
            progress.reached(min(row + 1, count))

    def _thinned(self, fused: int, frames: int) -> list[str]:
        if self.min_motion_m == 0 or fused == frames:
            return []
        return [f"{fused} of {frames} frames fused: one each min_motion_m = {self.min_motion_m:g} of the path"]

    def _notes(self, voxel_m: float, triangles: int, min_weight: float) -> list[str]:
        notes = []
        if voxel_m > self.voxel_m:
            notes.append(
                f"voxels of {voxel_m:g} m instead of {self.voxel_m:g} m: the mesh would take more than "
                f"memory_limit_mb = {self.memory_limit_mb:g}"
            )
        if triangles == 0:
            notes.append(f"the mesh is empty: no surface was seen by more than min_weight = {min_weight:g} frames")
        return notes


def _coloured_first(posed_frames: list[tuple[Frame, Floats]]) -> Views:
    """The views with those fused with colour, evenly spread, before the others, as `BlockGrid` needs them."""
    step = min(MOST_BETWEEN, max(1, len(posed_frames) // FEWEST_COLOURED))
    views = [(frame, pose, row % step == 0) for row, (frame, pose) in enumerate(posed_frames)]
    return sorted(views, key=lambda view: not view[2])
