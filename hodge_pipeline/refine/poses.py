"""The recipe's refiner as a step."""

from __future__ import annotations

import numpy as np

from hodge_pipeline.errors import GraphError
from hodge_pipeline.stages import Refiner, Step
from hodge_pipeline.types import Floats, Source


def refine_poses(refiner: Refiner, source: Source, world_from_cam: Floats, *, step: Step) -> Floats:
    """Step: the poses (N, 4, 4) of all frames that a refiner makes of these.

    Raises `GraphError` where it gives another number of poses, or loses one.
    """
    found = np.asarray(refiner.refine(source.frames, world_from_cam, step.advance), float)
    lost = np.isfinite(world_from_cam).all() and not np.isfinite(found).all()
    if found.shape != world_from_cam.shape or lost:
        raise GraphError(
            f"the refiner gave {found.shape} poses for {world_from_cam.shape}, or some that are not finite"
        )
    return found
