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

SAME_SHIFT = 0.5
"""Share of a shift by which loops that agree on it may differ: floors drift by less. Of 47 unused loops of Bicocca that
one mistake makes likelier some shift by 0.4 m, some by 14.6 m this way and some the other way.
"""


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


def shared_shift(chain: Chain, poses: Floats, rows: Ints) -> tuple[Floats, int]:
    """The median shift (3,) in the world's axes by which loops (rows) take the places of their later ends from where
    poses (n, 4, 4) have them; and how many of them take them nearly so far there.
    """
    i, j = chain.ends[rows].T
    shifts = (poses[i] @ chain.motion[rows] - poses[j])[:, :3, 3]
    usual = np.median(shifts, axis=0)
    return usual, int((np.linalg.norm(shifts - usual, axis=1) < SAME_SHIFT * np.linalg.norm(usual)).sum())


def without_shift(chain: Chain, poses: Floats, rows: Ints, shift: Floats) -> Chain:
    """The chain with loops (rows) that do not take places aside by a shift (3,) at poses (n, 4, 4)."""
    motion, aside = chain.motion.copy(), np.zeros((4, 4))
    aside[:3, 3] = shift
    motion[rows] -= se3.inverse(poses[chain.ends[rows, 0]]) @ aside
    return replace(chain, motion=motion)
