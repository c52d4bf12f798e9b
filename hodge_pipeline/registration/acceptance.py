"""Which registered pairs become edges: judged by themselves, and against the odometry between their frames."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from hodge_pipeline.registration.assessment import MOST_VIOLATION, SAME_FITNESS
from hodge_pipeline.registration.odometry_path import contradicts_odometry, without_slides
from hodge_pipeline.registration.seen_through import is_refuted
from hodge_pipeline.registration.sliding import are_steps, may_slide
from hodge_pipeline.scene import Drift
from hodge_pipeline.types import Edges, Ints
from hodge_pipeline.types.edges import HELD_OUT, REGISTERED, REJECTED, USED

CONTRADICTS, SEEN_THROUGH = "contradicts odometry", "one camera saw through the other's surface"


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class Acceptance:
    """Which registered pairs become edges; the others are counted and listed with the reason."""

    min_fitness: float = Field(
        default=0.3,
        ge=0,
        le=1,
        description="share of cloud j with a point of cloud i nearby; below it too little holds the pair",
    )
    max_rmse_m: float | None = Field(
        default=0.06,
        gt=0,
        description="metres: RMS distance of those points; two 3 cm grids of one surface differ by 2 to 4 cm. "
        "null: any",
    )
    min_spread: float = Field(
        default=0.01,
        ge=0,
        le=0.3,
        description="share of a pair's information on translation that its weakest direction has, at most a third; "
        "below it what both see, such as a bare floor or wall, lets them slide on each other wherever the guess is "
        "wrong. 0.01: normals within 6° of each other. Consecutive frames, and all below twice that, "
        "stay at their guess in such a direction",
    )
    max_seen_through: float | None = Field(
        default=MOST_VIOLATION,
        gt=0,
        lt=1,
        description="share of the points in view that the other depth image of a pair saw through, at most: more has a "
        "pair that slid along a counter, a table or a wall, however well these fit. Of depth images alone, and not "
        "where landmarks gave the motion; null: any",
    )

    def reasons(self, registered: Edges, in_order: bool = True) -> NDArray[np.str_]:
        """Why each pair (P,) is rejected by itself, an empty word where it is accepted.

        Steps of frames that are `in_order` may slide: they stay at their guess.
        """
        out = np.full(len(registered.pairs), "", "U64")
        slides = may_slide(registered, self.min_spread) & ~(in_order & are_steps(registered))
        out[slides] = "what they share lets them slide"
        out[is_refuted(registered, self.max_seen_through)] = SEEN_THROUGH
        if self.max_rmse_m is not None:
            out[~(registered.rmse_m <= self.max_rmse_m)] = "points too far apart"
        out[~(registered.fitness >= self.min_fitness)] = "too little overlap"
        out[registered.correspondences == 0] = "nothing in common"
        return out


def accepted(edges: Edges, acceptance: Acceptance, drift: Drift | None, in_order: bool = True) -> tuple[Edges, Ints]:
    """The table with `status` (used or rejected) and `why` of every registered pair, and the rows (S,) to which an
    odometry step slid unnoticed, as the pairs across that step agree. Held-out pairs stay as they are.

    `drift`: odometry's poses and their covariance, None without odometry. `in_order`: whether consecutive rows are
    steps of a path.
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
    """The table with every odometry step whose registration was rejected as contradicting odometry, or by free space,
    accepted again: with odometry's own measurement, or with the registration where that contradicts odometry alone and
    fits better by more than `SAME_FITNESS`.

    Where clouds slide, the round's registration of a step may end elsewhere than odometry's.
    """
    steps = np.flatnonzero((odometry.proposed_by == "sequential") & (odometry.status == USED))
    measured = {(int(i), int(j)): int(row) for row, (i, j) in zip(steps, odometry.pairs[steps], strict=True)}
    doubted = np.flatnonzero(np.isin(edges.why, (CONTRADICTS, SEEN_THROUGH)))
    again = [row for row in doubted if tuple(edges.pairs[row].tolist()) in measured]
    rows = np.array([measured[int(i), int(j)] for i, j in edges.pairs[again]], np.int64)
    lost = np.array(again, np.int64)
    worse = (edges.why[lost] == CONTRADICTS) & (odometry.fitness[rows] < edges.fitness[lost] - SAME_FITNESS)
    columns = {name: getattr(odometry, name)[rows[~worse]] for name in REGISTERED}
    return edges.put(lost, status=USED, why="").put(lost[~worse], **columns)
