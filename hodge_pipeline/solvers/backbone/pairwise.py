"""Loops of a chain compared pair by pair: whether one is right given that another is."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from hodge_pipeline import se3
from hodge_pipeline.complex.chi2 import STUDENT_99
from hodge_pipeline.solvers.backbone.chain import Chain
from hodge_pipeline.solvers.backbone.evidence import BY_CHANCE, log_student, student_log_density
from hodge_pipeline.solvers.backbone.judge import Judged
from hodge_pipeline.solvers.backbone.linear import Linear, shifted, turned
from hodge_pipeline.solvers.backbone.loop_places import loops_at_place
from hodge_pipeline.types import Bools, Floats, Ints

NEIGHBOURS, SEEDS = 8, 16
"""Nearest loops that each loop is compared with, and seeds that are then compared with all: limits on cost."""
LOOSE = 2.0
"""Factor from the standard deviations of the one loop that a bridge follows from to those of the bridge."""


@dataclass(frozen=True)
class PairwiseConsistency:
    """Loops of a chain compared pair by pair, as pairwise consistency maximisation does (Mangelson et al. 2018).

    - `linear`: the bare chain, in which the paths between the loops' ends have their covariance.
    - `by_chain (M,)`: the log Bayes factor of each loop by the chain as it stands; `log_wrong (M,)`: the log-density of
      each residual if the loop is wrong; `used (M,)`: loops that agree with the chain.
    """

    linear: Linear
    by_chain: Floats
    log_wrong: Floats
    used: Bools

    @classmethod
    def of(cls, linear: Linear, log_wrong: Floats) -> PairwiseConsistency:
        """Loops none of which the chain explains, and none of which is used."""
        none = np.zeros(len(log_wrong))
        return cls(linear, none, log_wrong, none > 0)

    @property
    def chain(self) -> Chain:
        """The chain of the loops."""
        return self.linear.chain

    def factor(self, first: Ints, second: Ints) -> Floats:
        """Log Bayes factor (K,) of the loops `second` given that the loops `first` are right: by the paths between
        their lower ends and between their upper ends, whatever lies between lower and upper.
        """
        return np.asarray(student_log_density(*self.residuals(first, second))[0] - self.log_wrong[second])

    def residuals(self, first: Ints, second: Ints) -> tuple[Floats, Floats]:
        """Residuals (K, p) of loops `second`, and covariances (K, p, p), given that loops `first` are right."""
        chain, (c, d) = self.chain, self.chain.ends[second].T
        poses, covariance = self.predicted(first, c, d)
        residual = chain.log(chain.between(chain.motion[second], chain.between(self.linear.poses[c], poses)))
        return residual, covariance + chain.covariance[second]

    def predicted(self, loop: Ints, low: Ints, high: Ints) -> tuple[Floats, Floats]:
        """Poses (K, 4, 4) of positions `high`, reached from positions `low` through the loops, not along the chain; and
        the covariance (K, p, p) of the motion from `low`, in the axes of `high`.
        """
        chain, poses, total = self.chain, self.linear.poses, self.linear.covariance
        a, b = chain.ends[loop].T
        from_end = chain.between(poses[b], poses[high])
        end = poses[a] @ chain.motion[loop] @ from_end

        def local(frame: Floats, covariance: Floats) -> Floats:
            return chain.carried(se3.inverse(turned(frame)), shifted(covariance, chain.lever(frame[:, :3, 3])))

        before = local(end, total[np.maximum(a, low)] - total[np.minimum(a, low)])
        after = local(poses[high], total[np.maximum(b, high)] - total[np.minimum(b, high)])
        return end, before + after + chain.carried(se3.inverse(from_end), chain.covariance[loop])

    def bridge(self, loop: int, low: int, high: int) -> tuple[Floats, Floats]:
        """The motion (4, 4) from position `low` to position `high` that a loop asks for, and its covariance (p, p)."""
        end, covariance = self.predicted(np.array([loop]), np.array([low]), np.array([high]))
        motion = se3.inverse(self.linear.poses[low]) @ end[0]
        motion[:3, :3] = se3.project_to_so3(motion[:3, :3])  # else rounding doubles with each path
        return motion, LOOSE**2 * covariance[0]

    def seeds(self, among: Ints) -> Iterator[tuple[int, Floats]]:
        """Unused loops that contradict each other, those first with which most others near them agree, all of one place
        counting as one; and the log Bayes factor (K,) of each loop of `among (K,)` given that one.
        """
        left = ~self.used[among]
        support = np.full(len(among), -1.0)
        support[left] = self._support(among[left])
        for _ in range(SEEDS):
            if not left.any():
                return
            row = int(np.argmax(np.where(left, support, -1.0)))
            factor = self.factor(np.full(len(among), among[row]), among)
            left &= factor <= 0
            left[row] = False
            yield int(among[row]), factor

    def _support(self, rows: Ints) -> Floats:
        """Nats (K,) that the nearest loops of each of `rows (K,)` gain if it is right, of its own place as one."""
        if not len(rows):
            return np.zeros(0)
        near = cKDTree(self.chain.places[rows]).query(self.chain.places[rows], k=min(4 * NEIGHBOURS, len(rows)))[1]
        near = near.reshape(len(rows), -1)
        apart = np.abs(self.chain.places[rows[near]] - self.chain.places[rows][:, None]).max(axis=2) >= 1.0
        same = ~apart & (near != np.arange(len(rows))[:, None])
        support = np.zeros(len(rows))
        for kind in (apart, same):
            first, nth = np.nonzero(kind & (np.cumsum(kind, axis=1) <= NEIGHBOURS))
            second = rows[near[first, nth]]
            gain = np.maximum(np.logaddexp(self.factor(rows[first], second), 0.0) - self.by_chain[second], 0.0)
            share = 1.0 if kind is apart else 1 / np.bincount(first, minlength=len(rows))[first]
            support += np.bincount(first, share * gain, minlength=len(rows))
        return support

    def gains(self, seed: int, rows: Ints, factor: Floats) -> Floats:
        """Nats (K,) that the loops `rows (K,)` gain if `seed` is right, given their log Bayes factors (K,): each place
        counts once, the seed's own not at all. Used loops, which the chain explains, may only lose.
        """
        agrees = factor > 0
        share = (agrees.sum() + 0.5) / (len(rows) + 1)
        gain = np.logaddexp(np.log(share) + factor, np.log1p(-share)) - self.by_chain[rows]
        for alike in (agrees, ~agrees):
            if alike.any():
                gain[alike] /= loops_at_place(self.chain.places[rows[alike]])
        gain[np.abs(self.chain.places[rows] - self.chain.places[seed]).max(axis=1) < 1.0] = 0.0
        return np.asarray(np.where(self.used[rows], np.minimum(gain, 0.0), gain))


def likely_together(linear: Linear, judged: Judged, among: Bools) -> Bools:
    """Of the loops `among (M,)`, as they were judged, those that agree with one of them, in more places than by chance,
    where each fits the path and none could stand out alone if it fitted better: after a long way nearly any loop fits.
    """
    size, alone = len(linear.chain.axes), float(np.log(len(among)))
    could = judged.factor + log_student(0.0, size) - log_student(judged.chi2, size)
    rows = np.flatnonzero(among & (judged.chi2 <= STUDENT_99[size]) & (could <= alone))
    found, pairwise = np.zeros_like(among), PairwiseConsistency(linear, judged.factor, judged.log_wrong, ~among)
    for seed, factor in pairwise.seeds(rows) if len(rows) else ():
        if pairwise.gains(seed, rows, factor).sum() > BY_CHANCE + alone:
            found[rows[factor > 0]] = found[seed] = True
            break
    return found
