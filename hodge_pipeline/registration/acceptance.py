"""Which registered pairs of a run become edges: by themselves, and by what odometry says of the way between them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hodge_pipeline import se3
from hodge_pipeline.complex.components import connected_components
from hodge_pipeline.store import artifacts
from hodge_pipeline.store.job import Job
from hodge_pipeline.types import Bools, Edges, Floats, Ints
from hodge_pipeline.types.edges import HELD_OUT, REJECTED, USED

ARM_M = 1.0
"""A rotation counts as the displacement that it causes at this distance."""
LEAST_WAY_M = 0.05
"""Added to every way: frames of a camera at rest differ by what a registration errs."""


def accepted(job: Job, edges: Edges) -> Edges:
    """The table with `status` and `why` of every registered pair: used, or rejected; those held out stay so."""
    rows = np.flatnonzero(edges.status != HELD_OUT)
    reasons = _rejections(job, edges.select(rows))
    return edges.put(rows, status=np.where(reasons == "", USED, REJECTED), why=reasons)


def _rejections(job: Job, registered: Edges) -> NDArray[np.str_]:
    """Why each pair (P,) is no edge, an empty word where it is one."""
    reasons = job.recipe.acceptance.reasons(registered)
    odometry = _odometry(job)
    if odometry is not None:
        scale = job.recipe.scale if isinstance(job.recipe.scale, float) else 1.0
        far = strays(registered, *odometry, job.recipe.odometry.max_drift, scale)
        reasons[(reasons == "") & far] = "farther off than odometry drifts"
    return reasons


def strays(registered: Edges, world_from_cam: Floats, part: Ints, max_drift: float, scale: float = 1.0) -> Bools:
    """Where (P,) a pair contradicts odometry, poses (N, 4, 4), by more than this share of the way between its frames.

    Odometry knows nothing of a pair across two parts (N,) that it left apart. Lengths are multiplied by `scale`.
    """
    i, j = registered.pairs.T
    steps = _lengths(se3.inverse(world_from_cam[:-1]) @ world_from_cam[1:], ARM_M * scale)
    gone = np.concatenate([[0.0], np.cumsum(steps)])
    moved = se3.inverse(se3.inverse(world_from_cam[i]) @ world_from_cam[j]) @ registered.i_from_j
    allowed = max_drift * (LEAST_WAY_M * scale + np.abs(gone[j] - gone[i]))
    return np.asarray((part[i] == part[j]) & (_lengths(moved, ARM_M * scale) > allowed))


def _odometry(job: Job) -> tuple[Floats, Ints] | None:
    """The poses (N, 4, 4) that odometry or tracking led to, and the part (N,) of each frame that it held together."""
    if job.given is not None or "odometry" not in job.keys:
        return None
    if job.tracked is not None:
        return job.tracked.world_from_key, job.tracked.piece
    folder = job.path("odometry")
    poses = artifacts.load_arrays(folder / "poses.npz")["world_from_cam"]
    return poses, connected_components(artifacts.load(folder / "steps.npz", Edges).pairs, len(poses))


def _lengths(motions: Floats, arm_m: float) -> Floats:
    turned = np.linalg.norm(se3.so3_log(motions[:, :3, :3]), axis=1)
    return np.asarray(np.linalg.norm(motions[:, :3, 3], axis=1) + arm_m * turned)
