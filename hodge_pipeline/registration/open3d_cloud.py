"""A cloud as open3d wants it, and what its registrars share: assessed like every other."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any

import numpy as np
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from hodge_pipeline import se3
from hodge_pipeline.registration.assessment import MIN_POINTS, to_registration, unregistered
from hodge_pipeline.registration.clouds import NORMAL_NEIGHBOURS
from hodge_pipeline.registration.gicp import PreparedCloud
from hodge_pipeline.registration.one_thread import o3d
from hodge_pipeline.types import Floats, PointCloud, Registration

Align = Callable[["Open3dCloud", "Open3dCloud", float, Floats], Any]
"""One level: (target, source, distance in metres or voxel, guess) to open3d's result."""


class Open3dCloud(PreparedCloud):
    """Adds open3d's own cloud to the trees that the assessment needs."""

    def __init__(self, cloud: PointCloud) -> None:
        super().__init__(cloud, NORMAL_NEIGHBOURS)
        finite = np.isfinite(cloud.points_in_cam).all(axis=1)
        self._colours = None if cloud.colours is None else np.asarray(cloud.colours[finite], float) / 255.0

    @property
    def has_colours(self) -> bool:
        """Whether any point has a colour: a frame without an image is black."""
        return self._colours is not None and bool(self._colours.any())

    @cached_property
    def geometry(self) -> Any:
        """The open3d cloud, with normals, and colours where there are any."""
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(self.points))
        cloud.normals = o3d.utility.Vector3dVector(self.normals)
        if self._colours is not None:
            cloud.colors = o3d.utility.Vector3dVector(self._colours)
        return cloud


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class Open3dRegistrar:
    """Options of all of open3d's registrars, and the registration level by level."""

    max_iterations: int = Field(default=30, ge=1, description="Steps at each level, at most.")
    points_per_sample: float = Field(
        default=100.0,
        gt=0,
        description="Points that count as one independent measurement in the information; as for gicp.",
    )

    def prepare(self, cloud: PointCloud) -> Open3dCloud:
        """The cloud with normals, colours and a tree, each made when it is first needed."""
        return Open3dCloud(cloud)

    def _registered(
        self,
        align: Align,
        levels: Sequence[float],
        pair: tuple[Open3dCloud, Open3dCloud],
        i_from_j: Floats,
        within_m: float,
    ) -> Registration:
        """Cloud j, the second of the pair, moved onto cloud i, level by level; assessed within `within_m`."""
        guess, (target, source) = np.asarray(i_from_j, np.float64), pair
        if min(len(target), len(source)) < MIN_POINTS:
            return unregistered(guess)
        motion = guess
        for level in levels:
            try:
                result = align(target, source, level, motion)
            except RuntimeError:  # open3d found no correspondence, or no voxel with enough points
                return unregistered(guess)
            if not se3.is_motion(result.transformation):
                return unregistered(guess)
            motion = se3.from_parts(se3.project_to_so3(result.transformation[:3, :3]), result.transformation[:3, 3])
        assessment = target.assess(source, np.arange(len(source)), motion, within_m, self.points_per_sample)
        return to_registration(assessment, motion, len(levels), converged=True)
