"""Pairs tested against the odometry path between their frames, by the covariances of both.

Errors of steps are taken as independent, so their covariances add up along the path. A few steps err by much more than
their covariance, hence Student's distribution; a step that slid unnoticed is found by the pairs across it, which agree.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.complex.chi2 import FREEDOM, tail_gate
from hodge_pipeline.complex.components import connected_components
from hodge_pipeline.scene import Drift
from hodge_pipeline.types import Bools, Edges, Floats, Ints

WITNESS = 3.0
"""Change of a pair's log-likelihood, in nats, from which it counts for, or against, the correction of a step."""
FEWEST_FOR, MOST_AGAINST = 3, 0.1
"""Pairs that must support a correction, and opposing ones per supporting one at most: wrong pairs oppose by chance."""
SEEDS, LONGEST, MOST_SLIDES = 16, 8, 10
"""Limits on cost: pairs taken as a step's correction, steps tried for each, and steps corrected in all."""


def drift_of(world_from_cam: Floats, steps: Edges, tail: float | None) -> Drift:
    """Odometry's poses (K, 4, 4) and the covariance of its path, from its steps, with the gate that a share `tail` of
    right pairs fails by chance; None: no gate.
    """
    covariance = np.zeros((len(world_from_cam), 6, 6))
    ends = steps.pairs.max(axis=1, initial=0)
    np.add.at(covariance, ends, se3.carried(world_from_cam[steps.pairs[:, 1]], se3.covariances(steps.information)))
    part = connected_components(steps.pairs, len(world_from_cam))
    gate = np.inf if tail is None else tail_gate(6, tail)
    return Drift(world_from_cam, part, np.cumsum(covariance, axis=0), gate)


def contradicts_odometry(registered: Edges, drift: Drift) -> Bools:
    """Where (P,) a pair differs from odometry's motion by more than the gate on χ²; never between two components."""
    return _Pairs.of(registered).chi2(drift) > drift.gate


def without_slides(registered: Edges, drift: Drift) -> tuple[Drift, Ints]:
    """Odometry with the steps corrected that slid unnoticed, and the rows (S,) that these led to.

    A step slid where the shortest pair across it contradicts odometry, and correcting the step by that pair makes other
    pairs across it likelier and next to none less likely. Look-alike places have many pairs that agree, but no such
    shortest one.
    """
    pairs, slid = _Pairs.of(registered), list[int]()
    for _ in range(MOST_SLIDES):
        found = _slide(pairs, drift)
        if found is None:
            break
        drift, row = found
        slid.append(row)
    return drift, np.unique(np.array(slid, np.int64))


@dataclass(frozen=True)
class _Pairs:
    """Registered pairs by their `low` and `high (P,)` row, the motion from low to high, and its covariance."""

    low: Ints
    high: Ints
    motion: Floats
    covariance: Floats

    @classmethod
    def of(cls, registered: Edges) -> _Pairs:
        (i, j), motion, covariance = registered.pairs.T, registered.i_from_j, se3.covariances(registered.information)
        back = (i > j)[:, None, None]
        covariance = np.where(back, se3.carried(motion, covariance), covariance)
        return cls(np.minimum(i, j), np.maximum(i, j), np.where(back, se3.inverse(motion), motion), covariance)

    def chi2(self, drift: Drift) -> Floats:
        """Squared Mahalanobis distance (P,) from odometry's motions; 0 across two parts."""
        poses, low, high = drift.world_from_cam, self.low, self.high
        path = se3.carried(se3.inverse(poses[high]), drift.covariance[high] - drift.covariance[low])
        off = se3.log(se3.inverse(poses[high]) @ poses[low] @ self.motion)
        chi2 = np.einsum("ni,ni->n", off, np.linalg.solve(path + self.covariance, off[..., None])[..., 0])
        return np.asarray(np.where(drift.part[low] == drift.part[high], chi2, 0.0))

    def select(self, rows: Bools | Ints) -> _Pairs:
        """These rows."""
        return _Pairs(self.low[rows], self.high[rows], self.motion[rows], self.covariance[rows])


def _slide(pairs: _Pairs, drift: Drift) -> tuple[Drift, int] | None:
    """Odometry with the step corrected that most pairs support, and the row that it leads to; None where none is."""
    within = pairs.select(drift.part[pairs.low] == drift.part[pairs.high])
    before, span = within.chi2(drift), within.high - within.low
    far = np.flatnonzero(before > drift.gate)
    best, found = FEWEST_FOR - 0.5, None
    for seed in far[np.argsort(span[far], kind="stable")][:SEEDS].tolist():
        low, high = int(within.low[seed]), int(within.high[seed])
        for row in range(low + 1, min(high, low + LONGEST) + 1):
            over = np.flatnonzero((within.low < row) & (within.high >= row))
            if span[over].min() < span[seed]:
                continue
            corrected = _corrected(drift, row, within.select(np.array([seed])))
            gain = _log_density(within.select(over).chi2(corrected)) - _log_density(before[over])
            score = float((gain > WITNESS).sum() - (gain < -WITNESS).sum() / MOST_AGAINST)
            if score > best:
                best, found = score, (corrected, row)
    return found


def _log_density(chi2: Floats) -> Floats:
    """Of Student's distribution, but for a constant."""
    return np.asarray(-0.5 * (FREEDOM + 6) * np.log1p(chi2 / FREEDOM))


def _corrected(drift: Drift, row: int, seed: _Pairs) -> Drift:
    """Odometry with the step to `row` corrected so that it agrees with this one pair, with that pair's covariance."""
    poses, covariance = drift.world_from_cam.copy(), drift.covariance.copy()
    end = poses[seed.low[0]] @ seed.motion[0]
    behind = (np.arange(len(poses)) >= row) & (drift.part == drift.part[row])
    poses[behind] = end @ se3.inverse(poses[seed.high[0]]) @ poses[behind]
    covariance[row:] += se3.carried(end, seed.covariance[0])
    return replace(drift, world_from_cam=poses, covariance=covariance)
