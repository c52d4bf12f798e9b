"""Which registered pairs of a run become edges: by themselves, and by what odometry says of the way between them."""

from __future__ import annotations

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.registration.pairs import Acceptance
from hodge_pipeline.scene import Drift
from hodge_pipeline.types import Bools, Edges, Floats
from hodge_pipeline.types.edges import HELD_OUT, REJECTED, USED

ARM_M = 1.0
"""A rotation counts as the displacement that it causes at this distance."""
LEAST_WAY_M = 0.05
"""Added to every way: frames of a camera at rest differ by what a registration errs."""


def accepted(edges: Edges, acceptance: Acceptance, drift: Drift | None, scale: float = 1.0) -> Edges:
    """The table with `status` and `why` of every registered pair: used, or rejected; those held out stay so.

    `drift`: what odometry says of the way between two frames, None where it says nothing. `scale` multiplies lengths.
    """
    rows = np.flatnonzero(edges.status != HELD_OUT)
    registered = edges.select(rows)
    reasons = acceptance.reasons(registered)
    if drift is not None:
        far = strays(registered, drift, scale)
        reasons[(reasons == "") & far] = "farther off than odometry drifts"
    return edges.put(rows, status=np.where(reasons == "", USED, REJECTED), why=reasons)


def strays(registered: Edges, drift: Drift, scale: float = 1.0) -> Bools:
    """Where (P,) a pair contradicts odometry by more than the share of the way between its frames that this may err by.

    Odometry knows nothing of a pair across two parts that it left apart. Lengths are multiplied by `scale`.
    """
    world_from_cam, part = drift.world_from_cam, drift.part
    i, j = registered.pairs.T
    steps = _lengths(se3.inverse(world_from_cam[:-1]) @ world_from_cam[1:], ARM_M * scale)
    gone = np.concatenate([[0.0], np.cumsum(steps)])
    moved = se3.inverse(se3.inverse(world_from_cam[i]) @ world_from_cam[j]) @ registered.i_from_j
    allowed = drift.largest * (LEAST_WAY_M * scale + np.abs(gone[j] - gone[i]))
    return np.asarray((part[i] == part[j]) & (_lengths(moved, ARM_M * scale) > allowed))


def _lengths(motions: Floats, arm_m: float) -> Floats:
    turned = np.linalg.norm(se3.so3_log(motions[:, :3, :3]), axis=1)
    return np.asarray(np.linalg.norm(motions[:, :3, 3], axis=1) + arm_m * turned)
