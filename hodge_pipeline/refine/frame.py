"""The frame of a refined model: bundle adjustment leaves it free, and the input's is the user's."""

from __future__ import annotations

import numpy as np

from hodge_pipeline.evaluation.trajectory import align
from hodge_pipeline.types.tracked_model import TrackedModel

ROUNDS, MEDIANS = 10, 3.0
"""Fits of the frame, and the medians of the distances within which bodies take part: Gaussian noise leaves out one of
10^4."""
NO_BASELINE = 1e-9
"""Share of the model's size below which a sensor's distance from its rig's origin is rounding."""


def in_frame_of(start: TrackedModel, model: TrackedModel, *, keeps_size: bool = False) -> TrackedModel:
    """The model laid on the start by its bodies, in the start's size unless it `keeps_size`, as one with rigs does.

    Bodies that moved much farther than most are left out: an image that was wrong must not draw the world with it.
    """
    baselines = np.abs(start.body_from_cam[:, :3, 3]).max()
    keeps_size |= bool(baselines > NO_BASELINE * np.ptp(start.world_from_body[:, :3, 3], axis=0).max())
    before, after = start.world_from_body, model.world_from_body
    near = np.ones(len(before), bool)
    for _ in range(ROUNDS):
        found = align(after[near], before[near], with_scale=not keeps_size)
        if not found.scale > 0:  # the start's positions are all one
            return model
        off = np.linalg.norm(found.apply(after)[:, :3, 3] - before[:, :3, 3], axis=1)
        near = off <= MEDIANS * np.median(off)
    return model.scaled(found.scale, found.reference_from_estimate)
