"""Point-to-plane ICP (Chen and Medioni 1992) and coloured ICP (Park et al., ICCV 2017), by open3d."""

from __future__ import annotations

from typing import Any

from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from hodge_pipeline.registration.one_thread import o3d
from hodge_pipeline.registration.open3d_cloud import Open3dCloud, Open3dRegistrar
from hodge_pipeline.types import Floats, Registration

o3d_registration = o3d.pipelines.registration


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class PointToPlaneIcp(Open3dRegistrar):
    """Point-to-plane ICP: the least that works, three times the cost of gicp."""

    distances_m: tuple[float, ...] = Field(
        default=(0.3, 0.1, 0.05),
        min_length=1,
        description="Metres, coarse to fine: how far apart corresponding points may be. 0.3 forgives a start 10 cm and "
        "5° off.",
    )

    def register(self, target: Open3dCloud, source: Open3dCloud, i_from_j: Floats) -> Registration:
        """Cloud j (source) moved onto cloud i (target) from the guess."""
        return self._registered(self._align, self.distances_m, (target, source), i_from_j, min(self.distances_m))

    def _align(self, target: Open3dCloud, source: Open3dCloud, distance_m: float, guess: Floats) -> Any:
        return o3d_registration.registration_icp(
            source.geometry,
            target.geometry,
            distance_m,
            guess,
            o3d_registration.TransformationEstimationPointToPlane(),
            o3d_registration.ICPConvergenceCriteria(max_iteration=self.max_iterations),
        )


GEOMETRIC_SHARE = 0.968
"""Weight of geometry against colour; open3d's and the authors' own value."""


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class ColouredIcp(PointToPlaneIcp):
    """Coloured ICP: holds on to texture where the surfaces alone would slide; geometry alone without colours."""

    min_distance_m: float = Field(
        default=0.1,
        gt=0,
        description="Metres: levels with colour match at least so far apart, since open3d fits the gradients of colour "
        "within twice that; at 5 cm some points have too few neighbours, and their gradients threw pairs off by 0.4 m.",
    )

    def _align(self, target: Open3dCloud, source: Open3dCloud, distance_m: float, guess: Floats) -> Any:
        if not (target.has_colours and source.has_colours):
            return super()._align(target, source, distance_m, guess)
        return o3d_registration.registration_colored_icp(
            source.geometry,
            target.geometry,
            max(distance_m, self.min_distance_m),
            guess,
            o3d_registration.TransformationEstimationForColoredICP(lambda_geometric=GEOMETRIC_SHARE),
            o3d_registration.ICPConvergenceCriteria(max_iteration=self.max_iterations),
        )
