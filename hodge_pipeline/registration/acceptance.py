"""Which registered pairs become edges: judged by themselves, and against the odometry between their frames."""

from __future__ import annotations

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.registration.pairs import Acceptance
from hodge_pipeline.scene import Drift
from hodge_pipeline.types import Bools, Edges, Floats
from hodge_pipeline.types.edges import HELD_OUT, MEASURED, REJECTED, USED

MIN_PATH_M = 0.05
"""Added to the length of every path: frames of a camera at rest differ by the error of a registration."""

CONTRADICTS = "farther off than odometry drifts"


def accepted(edges: Edges, acceptance: Acceptance, drift: Drift | None, scale: float = 1.0) -> Edges:
    """The table with `status` and `why` of every registered pair: used, or rejected; those held out stay so.

    `drift`: how far odometry may be off between two frames; None without odometry. `scale` multiplies lengths.
    """
    rows = np.flatnonzero(edges.status != HELD_OUT)
    registered = edges.select(rows)
    reasons = acceptance.reasons(registered)
    if drift is not None:
        far = contradicts_odometry(registered, drift, scale)
        reasons[(reasons == "") & far] = CONTRADICTS
    return edges.put(rows, status=np.where(reasons == "", USED, REJECTED), why=reasons)


def with_odometry(edges: Edges, odometry: Edges) -> Edges:
    """The table with odometry's own measurements, which count, in the place of registrations that contradict them.

    Where clouds slide, a registration from the poses of a round ends where one from the step before did not.
    """
    steps = np.flatnonzero((odometry.proposed_by == "sequential") & (odometry.status == USED))
    measured = {(int(i), int(j)): int(row) for row, (i, j) in zip(steps, odometry.pairs[steps], strict=True)}
    lost = [row for row in np.flatnonzero(edges.why == CONTRADICTS) if tuple(edges.pairs[row].tolist()) in measured]
    rows = [measured[int(i), int(j)] for i, j in edges.pairs[lost]]
    columns = {name: getattr(odometry, name)[rows] for name in (*MEASURED, "iterations", "converged")}
    return edges.put(np.array(lost, np.int64), status=USED, why="", **columns)


def contradicts_odometry(registered: Edges, drift: Drift, scale: float = 1.0) -> Bools:
    """Where (P,) a pair is off odometry's motion by more than the allowed share of the path between its frames.

    Never for a pair across two parts that odometry left apart. Lengths are multiplied by `scale`.
    """
    world_from_cam, part = drift.world_from_cam, drift.part
    i, j = registered.pairs.T
    steps = _displacement_m(se3.inverse(world_from_cam[:-1]) @ world_from_cam[1:], se3.ARM_M * scale)
    path_m = np.concatenate([[0.0], np.cumsum(steps)])
    moved = se3.inverse(se3.inverse(world_from_cam[i]) @ world_from_cam[j]) @ registered.i_from_j
    allowed = drift.largest * (MIN_PATH_M * scale + np.abs(path_m[j] - path_m[i]))
    return np.asarray((part[i] == part[j]) & (_displacement_m(moved, se3.ARM_M * scale) > allowed))


def _displacement_m(motions: Floats, arm_m: float) -> Floats:
    return np.asarray(np.linalg.norm(motions[:, :3, 3], axis=1) + arm_m * se3.rotation_angle(motions))
