"""A correction that is known at some moments, spread over all moments between."""

from __future__ import annotations

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.errors import GraphError
from hodge_pipeline.types import Floats


def spread_correction(
    times: Floats, world_from_cam: Floats, key_times: Floats, key_before: Floats, key_after: Floats
) -> Floats:
    """The poses (N, 4, 4) at `times (N,)`, corrected as the key poses (K, 4, 4) at `key_times (K,)` were.

    A correction is the motion in the world that takes a key pose from before to after. Between two key moments it is
    interpolated on SE(3) about the pose that it moves, so that the result depends neither on the world's origin nor on
    what the pose is of (camera or body); a pose at a key moment moves exactly as the key pose did. Before the first
    and after the last key moment the nearest correction holds.
    """
    times, key_times = np.asarray(times, float), np.asarray(key_times, float)
    if not len(key_times) or (np.diff(key_times) <= 0).any():
        raise GraphError(f"{len(key_times)} key poses: need at least one, at moments that ascend")
    after = np.clip(np.searchsorted(key_times, times, side="right"), 1, max(len(key_times) - 1, 1))
    before = after - 1
    after = np.minimum(after, len(key_times) - 1)
    span = key_times[after] - key_times[before]
    share = np.clip((times - key_times[before]) / np.where(span > 0, span, 1.0), 0.0, 1.0)
    corrections = key_after @ se3.inverse(key_before)
    about = np.broadcast_to(np.eye(4), (len(times), 4, 4)).copy()
    about[:, :3, 3] = world_from_cam[:, :3, 3]
    back = se3.inverse(about)
    local = se3.interpolate(back @ corrections[before] @ about, back @ corrections[after] @ about, share)
    return np.asarray(about @ local @ back @ world_from_cam)
