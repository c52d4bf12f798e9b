"""The normal distributions transform (Biber and Strasser 2003; Magnusson 2009), by open3d."""

from __future__ import annotations

from typing import Any

from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from hodge_pipeline.registration.one_thread import o3d
from hodge_pipeline.registration.open3d_cloud import Open3dCloud, Open3dRegistrar
from hodge_pipeline.types import Floats, Registration


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class Ndt(Open3dRegistrar):
    """Cloud j against Gaussians in voxels of cloud i: no correspondences, a wide basin."""

    voxels_m: tuple[float, ...] = Field(
        default=(0.5, 0.25),
        min_length=1,
        description="Metres, coarse to fine: side of a voxel. Below about 0.2 too few points of a 3 cm cloud fill one.",
    )
    assessed_within_m: float = Field(
        default=0.1, gt=0, description="metres: points of j this near to one of i count in fitness and information"
    )

    def register(self, target: Open3dCloud, source: Open3dCloud, i_from_j: Floats) -> Registration:
        """Cloud j (source) moved onto cloud i (target) from the guess."""
        return self._registered(self._align, self.voxels_m, (target, source), i_from_j, self.assessed_within_m)

    def _align(self, target: Open3dCloud, source: Open3dCloud, voxel_m: float, guess: Floats) -> Any:
        option = o3d.pipelines.registration.NormalDistributionsTransformOption(
            voxel_size=voxel_m, max_iteration=self.max_iterations
        )
        return o3d.pipelines.registration.registration_ndt(source.geometry, target.geometry, option, guess)
