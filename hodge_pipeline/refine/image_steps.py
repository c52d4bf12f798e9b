"""Poses tested by optical flow: how far steps between frames lie from those that corners, tracked, show.

It is a test apart from the clouds, which a sensor may warp alike in every frame: they then fit each other best at wrong
poses. Depth enters by the parallax alone, so depth that is 5 % off makes a step 5 % longer or shorter.
"""

from __future__ import annotations

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.errors import SourceError
from hodge_pipeline.registration.tracking.flow import FlowImage, find_corners, flow_image, follow
from hodge_pipeline.stages import Step
from hodge_pipeline.types import Floats, Frame, Ints, Source

MOST_STEPS = 100
"""Steps that are tested, evenly over the sequence: 30 ms each at 640x480."""
RANGE_M = (0.1, 100.0)
"""Depth that counts, in units of the recipe's scale."""


def step_errors_m(source: Source, pairs: Ints, pose_sets: Floats, unit_m: float, *, step: Step) -> Floats:
    """Step: how far (S, P) steps between pairs (P, 2) of frames, under sets of poses (S, K, 4, 4), lie from those that
    images show.

    NaN where a pair has no readable images, or too few of its corners agree on a motion. `unit_m`: the recipe's scale.
    """
    off_m = np.full((len(pose_sets), len(pairs)), np.nan)
    images: dict[int, FlowImage | None] = {}
    for column, (i, j) in enumerate(pairs.tolist()):
        images = {row: images[row] if row in images else _read(source.frames[row], unit_m) for row in (i, j)}
        one, other = images[i], images[j]
        i_from_j = se3.inverse(pose_sets[:, i]) @ pose_sets[:, j]
        found = None if one is None or other is None else follow(find_corners(one), other, i_from_j[0])
        if found is not None:
            off_m[:, column] = np.linalg.norm((se3.inverse(found.key_from_view) @ i_from_j)[:, :3, 3], axis=1)
        step.advance(1)
    return off_m


def _read(frame: Frame, unit_m: float) -> FlowImage | None:
    try:
        return flow_image(frame, (RANGE_M[0] * unit_m, RANGE_M[1] * unit_m), unit_m)
    except (SourceError, OSError):
        return None
