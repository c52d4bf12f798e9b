"""Loops that are mistaken in one way: between floors that look alike, or from each row of a field to the next one."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from hodge_pipeline import se3
from hodge_pipeline.complex.chi2 import STUDENT_99
from hodge_pipeline.solvers.backbone.chain import Chain
from hodge_pipeline.solvers.backbone.evidence import mahalanobis
from hodge_pipeline.solvers.backbone.judge import by_path
from hodge_pipeline.solvers.backbone.linear import Linear
from hodge_pipeline.solvers.backbone.loop_places import loops_at_place, one_of_each_place
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


def elsewhere(chain: Chain, moved: Bools, rng: np.random.Generator) -> Chain:
    """The chain with the `moved (M,)` loops at other places drawn at random: those of one place move together, and
    agree with each other as they did.
    """
    rows = np.flatnonzero(moved)
    if not len(rows):
        return chain
    one = rows[one_of_each_place(chain.places[rows])]
    nearest = cKDTree(chain.places[one]).query(chain.places[rows], p=np.inf)[1]
    ends = chain.ends.copy()
    drawn = rng.integers(0, chain.size, (len(one), 2))
    first = np.searchsorted(chain.path, chain.path[drawn[nearest]])
    last = np.searchsorted(chain.path, chain.path[drawn[nearest]], side="right") - 1
    ends[rows] = np.clip(drawn[nearest] + chain.ends[rows] - chain.ends[one][nearest], first, last)
    alone = ends[:, 0] == ends[:, 1]  # moved to where a path ends
    ends[alone] = chain.ends[alone]
    motion, of = chain.motion.copy(), one[nearest]
    off = chain.between(_as_another(chain, chain.ends, rows, of), chain.motion[rows])
    motion[rows] = _as_another(chain, ends, rows, of) @ off
    turned = ends[:, 0] > ends[:, 1]
    motion[turned] = se3.inverse(motion[turned])
    return replace(chain, ends=np.sort(ends, axis=1), motion=motion)


def _as_another(chain: Chain, ends: Ints, rows: Ints, others: Ints) -> Floats:
    """The motions (K, 4, 4) of loops `rows (K,)` with these ends (M, 2) by those of `others (K,)`, along the steps."""
    poses, ((i, j), (a, b)) = chain.poses, (ends[rows].T, ends[others].T)
    before, after = chain.between(poses[i], poses[a]), chain.between(poses[b], poses[j])
    return np.asarray(before @ chain.motion[others] @ after)
