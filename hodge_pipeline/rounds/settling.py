"""Whether rounds have settled on poses: how far the last one moved them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hodge_pipeline.evaluation.trajectory import absolute_error
from hodge_pipeline.scene import Round
from hodge_pipeline.types import Floats, Ints

UNSETTLED_M, UNSETTLED_SHARE = 0.05, 0.01
"""By how much (root mean square), and by which share of the path, the last of several rounds may move the positions.
Runs that end near the truth move by less than 1 cm, one whose edges slide along a bare floor by 30."""


def last_shift_m(rounds: Sequence[Round], component: Ints) -> float | None:
    """How far the last round moved the positions (root mean square, aligned); None where it is the first to solve, or
    that of edits, which are meant to move them.
    """
    if len(rounds) < 3 or rounds[-1].edited:
        return None
    shift_m = absolute_error(rounds[-2].world_from_cam, rounds[-1].world_from_cam, component).rmse_m
    return float(shift_m) if np.isfinite(shift_m) else None


def settled_m(positions: Floats, scale: float) -> float:
    """What the last round may move positions (N, 3) along a path by; `scale` is that of the recipe, 1 in a room."""
    path_m = float(np.nansum(np.linalg.norm(np.diff(positions, axis=0), axis=1)))
    return max(UNSETTLED_M * scale, UNSETTLED_SHARE * path_m)
