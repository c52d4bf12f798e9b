"""One rigid motion from matched points most of which may be wrong, by second-order spatial compatibility.

Chen et al., SC²-PCR (CVPR 2022): two right matches keep their distance; matches that share many such partners are
likely right. Nothing is drawn at random, so the answer is the same every time.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.types import Bools, Floats, Floats32, Ints

MOST_MATCHES = 1500
"""Matches compared with each other, the first ones given: 9 MB, about 40 ms."""
SEEDS = 160
"""Matches whose groups of compatible matches are tried as a motion."""
PARTNERS = 20
"""Compatible matches in such a group."""
FEWEST_MATCHES = 4
"""Three fix a motion, the fourth tests it."""
REFINEMENTS = 8
"""Least-squares fits to the inliers, at most."""


@dataclass(frozen=True)
class Consensus:
    """The motion `i_from_j` (4, 4), its inliers among the matches (M,), and its rival: the best motion by the outliers,
    with nearly as many inliers where places look alike or surfaces slide.
    """

    i_from_j: Floats
    inlier: Bools
    rival: Consensus | None = None

    @property
    def rival_count(self) -> int:
        """Inliers of the rival."""
        return 0 if self.rival is None else self.rival.count

    @property
    def count(self) -> int:
        """Inliers of the motion."""
        return int(self.inlier.sum())


def rigid_consensus(points_in_i: Floats, points_in_j: Floats, tolerance_m: float) -> Consensus:
    """The motion with most inliers among matches (M, 3), to within `tolerance_m`; the best matches come first.

    The identity with no inlier where there are fewer than four matches.
    """
    all_target, all_source = np.asarray(points_in_i, float), np.asarray(points_in_j, float)
    target, source = all_target[:MOST_MATCHES], all_source[:MOST_MATCHES]
    if len(target) < FEWEST_MATCHES:
        return Consensus(np.eye(4), np.zeros(len(all_target), bool))
    groups, weights = _compatible_groups(target, source, tolerance_m)
    motions = se3.fit_rigid(target[groups], source[groups], weights)
    moved = motions[:, :3, :3] @ source.T + motions[:, :3, 3:]
    squared = ((moved - target.T) ** 2).sum(axis=1) / tolerance_m**2
    support = np.maximum(0.0, 1 - squared)
    best = _refined(all_target, all_source, motions[int(support.sum(axis=1).argmax())], tolerance_m)
    left = ~best.inlier
    rival = motions[int(support[:, left[:MOST_MATCHES]].sum(axis=1).argmax())]
    return replace(best, rival=_refined(all_target[left], all_source[left], rival, tolerance_m))


def _compatible_groups(target: Floats, source: Floats, tolerance_m: float) -> tuple[Ints, Floats]:
    """For each of the best seeds the matches (S, K) that are the most compatible with it, and their weights (S, K)."""
    change = np.abs(_distances(target) - _distances(source)) / np.float32(tolerance_m)
    near = np.maximum(np.float32(0), 1 - change**2)
    np.fill_diagonal(near, 0)
    hard = (near > 0).astype(np.float32)
    second = hard * (near @ near.T)  # symmetric: half of the work
    order = np.argsort(-second.sum(axis=1), kind="stable")
    # seeds of all ranks: where most matches agree on a wrong motion, the right one is further down
    seeds = order[np.unique(np.linspace(0, len(order) - 1, min(SEEDS, len(order))).astype(np.int64))]
    seeds = np.unique(np.concatenate([order[: SEEDS // 2], seeds]))
    partners = min(PARTNERS, len(target) - 1)
    chosen = np.argpartition(-second[seeds], partners - 1, axis=1)[:, :partners]
    groups = np.concatenate([seeds[:, None], chosen], axis=1)
    weights = np.take_along_axis(second[seeds], chosen, axis=1)
    own = weights.max(axis=1, keepdims=True)
    return groups, np.concatenate([own, weights], axis=1).astype(float)


def _distances(points: Floats) -> Floats32:
    squared = (points**2).sum(axis=1)
    gram = squared[:, None] + squared[None, :] - 2 * (points @ points.T)
    return np.asarray(np.sqrt(np.maximum(gram, 0.0)), np.float32)


def _refined(target: Floats, source: Floats, motion: Floats, tolerance_m: float) -> Consensus:
    inlier = _within(target, source, motion, tolerance_m)
    for _ in range(REFINEMENTS):
        if inlier.sum() < FEWEST_MATCHES:
            return Consensus(np.eye(4), np.zeros(len(target), bool))
        better = se3.fit_rigid(target[inlier], source[inlier])
        agreeing = _within(target, source, better, tolerance_m)
        if agreeing.sum() < inlier.sum():
            break
        motion, same = better, np.array_equal(agreeing, inlier)
        inlier = agreeing
        if same:
            break
    return Consensus(motion, inlier)


def _within(target: Floats, source: Floats, motion: Floats, tolerance_m: float) -> Bools:
    return np.asarray(np.linalg.norm(se3.transform(motion, source) - target, axis=1) < tolerance_m)
