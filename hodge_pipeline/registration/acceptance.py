"""Which registered pairs become edges: judged by themselves, and against the odometry between their frames."""

from __future__ import annotations

import numpy as np

from hodge_pipeline.registration.assessment import SAME_FITNESS
from hodge_pipeline.registration.odometry_path import contradicts_odometry, without_slides
from hodge_pipeline.registration.pairs import Acceptance
from hodge_pipeline.scene import Drift
from hodge_pipeline.types import Edges, Ints
from hodge_pipeline.types.edges import HELD_OUT, REGISTERED, REJECTED, USED

CONTRADICTS = "contradicts odometry"


def accepted(edges: Edges, acceptance: Acceptance, drift: Drift | None, in_order: bool = True) -> tuple[Edges, Ints]:
    """The table with `status` and `why` of every registered pair: used, or rejected; those held out stay so. Beside it
    the rows (S,) that odometry slid to unnoticed, as the pairs over these steps agree.

    `drift`: what odometry says of the path between two frames; None without odometry. `in_order`: whether rows that
    follow each other are steps of a path.
    """
    rows = np.flatnonzero(edges.status != HELD_OUT)
    registered = edges.select(rows)
    reasons = acceptance.reasons(registered, in_order)
    slid = np.zeros(0, np.int64)
    if drift is not None:
        good = np.flatnonzero(reasons == "")
        drift, slid = without_slides(registered.select(good), drift)
        reasons[good[contradicts_odometry(registered.select(good), drift)]] = CONTRADICTS
    return edges.put(rows, status=np.where(reasons == "", USED, REJECTED), why=reasons), slid


def with_odometry(edges: Edges, odometry: Edges) -> Edges:
    """The table with odometry's own measurements, which count, in the place of registrations that contradict them, but
    for those that fit clearly better: these count.

    Where clouds slide, a registration from the poses of a round ends where one from the step before did not.
    """
    steps = np.flatnonzero((odometry.proposed_by == "sequential") & (odometry.status == USED))
    measured = {(int(i), int(j)): int(row) for row, (i, j) in zip(steps, odometry.pairs[steps], strict=True)}
    again = [row for row in np.flatnonzero(edges.why == CONTRADICTS) if tuple(edges.pairs[row].tolist()) in measured]
    rows = np.array([measured[int(i), int(j)] for i, j in edges.pairs[again]], np.int64)
    lost = np.array(again, np.int64)
    worse = odometry.fitness[rows] < edges.fitness[lost] - SAME_FITNESS
    columns = {name: getattr(odometry, name)[rows[~worse]] for name in REGISTERED}
    return edges.put(lost, status=USED, why="").put(lost[~worse], **columns)
