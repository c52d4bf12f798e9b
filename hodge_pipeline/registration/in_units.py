"""A registrar for clouds in another unit: its thresholds and sensor noise are in metres."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from pydantic import Field
from pydantic.dataclasses import dataclass

from hodge_pipeline import se3
from hodge_pipeline.stages import OPTIONS, Registrar
from hodge_pipeline.types import Floats, PointCloud, Registration


@dataclass(frozen=True, config=OPTIONS)
class InUnits:
    """Registers clouds with `unit_m` length units per metre; results are in the clouds' unit."""

    registrar: Registrar
    unit_m: float = Field(gt=0)

    def prepare(self, cloud: PointCloud) -> Any:
        """The cloud in the registrar's unit, prepared."""
        marks = cloud.landmarks
        if marks is not None:
            marks = replace(marks, points_in_cam=_in_unit(marks.points_in_cam, self.unit_m))
        return self.registrar.prepare(
            replace(cloud, points_in_cam=_in_unit(cloud.points_in_cam, self.unit_m), landmarks=marks)
        )

    def register(self, target: Any, source: Any, i_from_j: Floats) -> Registration:
        """Cloud j (source) moved onto cloud i (target) from the guess."""
        found = self.registrar.register(target, source, se3.rescaled(i_from_j, 1 / self.unit_m))
        return replace(
            found,
            i_from_j=se3.rescaled(found.i_from_j, self.unit_m),
            information=se3.rescaled_information(found.information, self.unit_m),
            rmse_m=found.rmse_m * self.unit_m,
        )


def _in_unit(points: Any, unit_m: float) -> Any:
    return (points / unit_m).astype(np.float32)
