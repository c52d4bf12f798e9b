"""Loops that are mistaken in one way: between floors that look alike, or from each row of a field to the next one."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.complex.chi2 import STUDENT_99
from hodge_pipeline.solvers.backbone.chain import Chain
from hodge_pipeline.solvers.backbone.evidence import mahalanobis
from hodge_pipeline.solvers.backbone.judge import by_path
from hodge_pipeline.solvers.backbone.linear import Linear
from hodge_pipeline.solvers.backbone.loop_places import loops_at_place
from hodge_pipeline.solvers.backbone.pairwise import PairwiseConsistency
from hodge_pipeline.types import Bools, Floats, Ints


@dataclass(frozen=True)
class Mistake:
    """Loops `rows (K,)` that agree with each other but for one motion of the world, and by how many nats they are
    likelier for it, beside the place that tells this motion and its choice among all places; 0 where they are not.
    `is_shift`: the motion turns nothing.
    """

    rows: Ints
    nats: float
    is_shift: bool


def mistakes(linear: Linear, log_wrong: Floats, used: Bools) -> Iterator[Mistake]:
    """Groups of the loops that are not `used (M,)`, each mistaken in one way, those first that most loops near them
    agree with; `log_wrong (M,)`: the log-density of each residual at the poses of `linear` if the loop is wrong in a
    way of its own.
    """
    rows = np.flatnonzero(~used)
    if not len(rows):
        return
    pairwise = PairwiseConsistency.of(linear, log_wrong)
    fold = float(np.log((1 / loops_at_place(linear.chain.places[rows])).sum()))
    left, split = np.ones(len(rows), bool), linear.chain.rotation_axes
    for seed, factor in pairwise.seeds(rows):
        nats = float(pairwise.gains(seed, rows, factor)[left].sum()) - fold
        chi2 = mahalanobis(linear.loops[0][[seed], :split], by_path(linear, np.array([seed]))[:, :split, :split])[0][0]
        yield Mistake(rows[left & (factor > 0)], max(nats, 0.0), bool(chi2 < STUDENT_99[split]))
        if nats > 0:
            left &= factor <= 0


def shifts(linear: Linear, rows: Ints) -> Floats:
    """How far loops (rows) take the places of their later ends from where the poses have them, (K, 3) in the world's
    axes.
    """
    chain, poses, (i, j) = linear.chain, linear.poses, linear.chain.ends[rows].T
    return np.asarray((chain.compose(poses[i], chain.motion[rows]) - poses[j])[:, :3, 3])


def without_shift(chain: Chain, linear: Linear, rows: Ints) -> Chain:
    """The chain with loops (rows) that do not have the shift which they share at the poses of `linear`."""
    poses, motion = linear.poses[chain.ends[rows, 0]], chain.motion.copy()
    back = np.zeros((len(rows), 4, 4))
    back[:, :3, 3] = np.median(shifts(linear, rows), axis=0)
    motion[rows] -= se3.inverse(poses) @ back
    return replace(chain, motion=motion)
