"""The Lie-algebra valued 1-form of the viewing graph."""

from __future__ import annotations

from typing import Literal

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.types import Floats, Ints

Logarithm = Literal["se3", "pairing"]


def residual_form(edges: Ints, i_from_j: Floats, world_from_cam: Floats, log: Logarithm = "se3") -> Floats:
    """ω (E, 6) = log(T_i Z_ij T_j⁻¹), order (rotation, translation), in the world frame of the poses given.

    It is 0 where an edge agrees with the poses. With `pairing` it is the paper's (φ, t), which is not antisymmetric.
    Far from the world's origin a rotation appears as a translation: shift the poses with `centred` first.
    """
    i, j = edges.T
    motion = world_from_cam[i] @ i_from_j @ se3.inverse(world_from_cam[j])
    return se3.pairing_log(motion) if log == "pairing" else se3.log(motion)


def centroids(world_from_cam: Floats, component: Ints) -> Floats:
    """The mean camera position (V, 3), metres, of the component of each vertex."""
    count = np.maximum(np.bincount(component), 1)
    sums = np.stack([np.bincount(component, world_from_cam[:, axis, 3]) for axis in range(3)], axis=1)
    return np.asarray((sums / count[:, None])[component])


def shifted(world_from_cam: Floats, offset: Floats) -> Floats:
    """The poses (V, 4, 4) with their positions moved by `offset (V, 3)` or (3,), metres."""
    out = np.array(world_from_cam, float)
    out[:, :3, 3] += offset
    return out
