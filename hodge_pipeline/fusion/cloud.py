"""One cloud from all frames: the mean point of each voxel. It needs no depth images: frames of points will do."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from hodge_pipeline import se3
from hodge_pipeline.errors import SourceError
from hodge_pipeline.fusion.depth_points import depth_points
from hodge_pipeline.fusion.views import Skipped, posed
from hodge_pipeline.fusion.voxel_cloud import VoxelCloud
from hodge_pipeline.stages import Advance, no_progress
from hodge_pipeline.types import Bools, Floats, Frame, Model, PointCloud

POINTS_AT_ONCE = 1 << 20


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
            notes.append(f"{far} points left out: more than a million voxels from the first frame")
        return notes
