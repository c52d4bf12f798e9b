"""Pairs held against the path of odometry between their frames, by the covariance of that path and their own.

Errors of steps add up along the path as if they were independent. Few steps err by much more than they say, so the
sum is compared under Student's distribution; one that slid unnoticed is found by the pairs over it, which agree.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.complex.components import connected_components
from hodge_pipeline.complex.judging import FREEDOM, tail_gate
from hodge_pipeline.scene import Drift
from hodge_pipeline.types import Bools, Edges, Floats, Ints

WITNESS = 3.0
"""Nats by which a pair must be likelier, or less likely, after a step is mended to count for that, or against it."""
FEWEST_FOR, MOST_AGAINST = 3, 0.1
"""Pairs that must say that a step slid, and for each so many that may say the contrary, as wrong ones do by chance."""
SEEDS, LONGEST, MOST_SLIDES = 16, 8, 10
"""Pairs that are asked where a step should have led, steps of each that are tried, and steps that are mended: limits on
cost.
"""


def drift_of(world_from_cam: Floats, steps: Edges, tail: float | None) -> Drift:
    """What odometry's poses (K, 4, 4) and the steps that led to them say of pairs; `tail` of right pairs, by chance,
    contradict it, None: no pair does.
    """
    covariance = np.zeros((len(world_from_cam), 6, 6))
    ends = steps.pairs.max(axis=1, initial=0)
    np.add.at(covariance, ends, se3.carried(world_from_cam[steps.pairs[:, 1]], se3.covariances(steps.information)))
    part = connected_components(steps.pairs, len(world_from_cam))
    gate = np.inf if tail is None else tail_gate(6, tail)
    return Drift(world_from_cam, part, np.cumsum(covariance, axis=0), gate)


def contradicts_odometry(registered: Edges, drift: Drift) -> Bools:
    """Where (P,) a pair is off odometry's motion by more than the covariances of both allow.

    Never for a pair across two parts that odometry left apart.
    """
    return _Pairs.of(registered).chi2(drift) > drift.gate


def without_slides(registered: Edges, drift: Drift) -> tuple[Drift, Ints]:
    """Odometry with steps mended that slid unnoticed, and the rows (S,) that these led to.

    A step slid where the pair over the fewest steps about it contradicts odometry, others over it are likelier if that
    pair is right, and next to none is less likely: places that look alike have many pairs that agree, but not that one.
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
        """These pairs alone."""
        return _Pairs(self.low[rows], self.high[rows], self.motion[rows], self.covariance[rows])


def _slide(pairs: _Pairs, drift: Drift) -> tuple[Drift, int] | None:
    """Odometry with that step mended for which most pairs speak, and the row that it leads to."""
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
            mended = _mended(drift, row, within.select(np.array([seed])))
            gain = _log_density(within.select(over).chi2(mended)) - _log_density(before[over])
            score = float((gain > WITNESS).sum() - (gain < -WITNESS).sum() / MOST_AGAINST)
            if score > best:
                best, found = score, (mended, row)
    return found


def _log_density(chi2: Floats) -> Floats:
    """Of Student's distribution, but for a constant."""
    return np.asarray(-0.5 * (FREEDOM + 6) * np.log1p(chi2 / FREEDOM))


def _mended(drift: Drift, row: int, seed: _Pairs) -> Drift:
    """Odometry whose step to `row` leads where this one pair says, as exactly as that pair does."""
    poses, covariance = drift.world_from_cam.copy(), drift.covariance.copy()
    end = poses[seed.low[0]] @ seed.motion[0]
    behind = (np.arange(len(poses)) >= row) & (drift.part == drift.part[row])
    poses[behind] = end @ se3.inverse(poses[seed.high[0]]) @ poses[behind]
    covariance[row:] += se3.carried(end, seed.covariance[0])
    return replace(drift, world_from_cam=poses, covariance=covariance)
