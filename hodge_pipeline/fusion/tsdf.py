"""A coloured mesh from depth images: truncated signed distances averaged in a sparse grid, then marching cubes."""

from __future__ import annotations

from collections.abc import Sequence

from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from hodge_pipeline.errors import SourceError
from hodge_pipeline.fusion.block_grid import BlockGrid, GridFull, blocks_within
from hodge_pipeline.fusion.views import Skipped, posed
from hodge_pipeline.stages import Advance, no_progress
from hodge_pipeline.types import Floats, Frame, Model


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class TsdfFuser:
    """Fuses depth images into a mesh."""

    voxel_m: float = Field(
        0.02, gt=0, description="metres: side of a voxel; 0.02 is near the noise of a depth camera in a room"
    )
    truncation_voxels: float = Field(
        4.0, ge=1, description="voxels: how far from the surface a distance is kept; must exceed depth noise and drift"
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
    colour: bool = Field(True, description="colour the mesh; without it fusion is a third faster")
    memory_limit_mb: float = Field(
        2000.0,
        ge=50,
        description="megabytes for the grid while it grows and is meshed (not for the mesh itself); a scene that "
        "needs more is fused again with voxels twice as large",
    )

    def fuse(self, frames: Sequence[Frame], world_from_cam: Floats, advance: Advance = no_progress) -> Model:
        """The mesh in the world frame, under the poses (N, 4, 4); its notes say what was left out.

        The same frames and poses give the same mesh. `SourceError` where no frame has a depth image.
        """
        if frames and not any(frame.read_depth and frame.camera for frame in frames):
            raise SourceError(
                f"fusion: tsdf: no frame, from {frames[0].frame_id} on, has a depth image: take fusion: cloud"
            )
        voxel_m, reported, grid = self.voxel_m, 0, None
        while grid is None:
            skipped = Skipped()
            views = posed(frames, world_from_cam, self.every, skipped, self.min_motion_m)
            grid, reported = self._integrated(views, voxel_m, skipped, reported, advance)
            voxel_m *= 2 if grid is None else 1
        advance(len(frames) - len(views))
        min_weight = min(self.min_weight, max(grid.views - 1.0, 0.0))
        points, normals, colours, triangles = grid.mesh(min_weight)
        return Model(
            name="mesh",
            points_in_world=points,
            normals_in_world=normals,
            colours=colours if grid.coloured else None,
            triangles=triangles,
            notes=(
                *skipped.notes(),
                *self._notes(voxel_m, len(triangles), min_weight),
                *self._thinned(len(views), len(frames)),
            ),
        )

    def _integrated(
        self, views: list[tuple[Frame, Floats]], voxel_m: float, skipped: Skipped, reported: int, advance: Advance
    ) -> tuple[BlockGrid | None, int]:
        """The grid, or None where it would pass the limit; and how many views `advance` has heard of."""
        limit = blocks_within(self.memory_limit_mb)
        colour = self.colour and any(frame.read_colour for frame, _ in views)
        grid = BlockGrid(voxel_m, self.truncation_voxels, self.max_depth_m, limit, colour)
        for row, (frame, pose) in enumerate(views):
            try:
                self._integrate(grid, frame, pose, skipped)
            except GridFull:
                return None, reported
            if row >= reported:
                advance(1)
                reported += 1
        return grid, reported

    def _integrate(self, grid: BlockGrid, frame: Frame, world_from_cam: Floats, skipped: Skipped) -> None:
        if frame.camera is None or frame.read_depth is None:
            skipped.add("no depth image", frame)
            return
        with skipped.unreadable(frame):
            depth_m = frame.read_depth()
            colour = skipped.colour(frame) if grid.colour else None
            if not grid.integrate(depth_m, colour, frame.camera, world_from_cam):
                skipped.add(f"no depth within max_depth_m = {self.max_depth_m:g}", frame)

    def _thinned(self, fused: int, frames: int) -> list[str]:
        if self.min_motion_m == 0 or fused == frames:
            return []
        return [f"{fused} of {frames} frames fused: one each min_motion_m = {self.min_motion_m:g} of the path"]

    def _notes(self, voxel_m: float, triangles: int, min_weight: float) -> list[str]:
        notes = []
        if voxel_m > self.voxel_m:
            notes.append(
                f"voxels of {voxel_m:g} m instead of {self.voxel_m:g} m: the scene would take more than "
                f"memory_limit_mb = {self.memory_limit_mb:g}"
            )
        if triangles == 0:
            notes.append(f"the mesh is empty: no surface was seen by more than min_weight = {min_weight:g} frames")
        return notes
