"""What a missing edge says: two views that lie upon each other, in a graph of all pairs, should be joined."""

from __future__ import annotations

import numpy as np

from hodge_pipeline.diagnosis.evidence import Evidence
from hodge_pipeline.diagnosis.votes import Votes
from hodge_pipeline.types import Floats, Ints

JOINED = 0.95
"""Probability that two views at the same place are joined by a right edge."""
RANGE = 1.2
"""In units of the reach: where that probability falls off."""
WIDEST_ANGLE_RAD = np.radians(40)
TRIED = 4
"""Hypotheses of each pair of pieces, the best so far, for which it is worked out."""


def overlap_costs(evidence: Evidence, votes: Votes, piece: Ints, piece_from: Floats, gain: Floats) -> Floats:
    """The cost (N,) in nats of each hypothesis: pairs of views that it lays upon each other and no agreeing edge joins.

    `gain (N,)` is what speaks for each; the best of each pair of pieces have a cost, the others are ruled out (∞).
    """
    cost = np.where(gain > 0, np.inf, 0.0)
    order = np.lexsort((-gain, votes.pair))
    rank = np.empty(len(order), np.int64)
    rank[order] = np.arange(len(order)) - votes.start[votes.pair[order]]
    members = [np.flatnonzero(piece == number) for number in range(evidence.vertex_count)]
    bounds = np.searchsorted(votes.hypothesis, np.arange(len(votes.edge) + 1))
    for row in np.flatnonzero((rank < TRIED) & (gain > 0)):
        compared = slice(bounds[row], bounds[row + 1])
        agreeing = votes.edge[votes.vote[compared][votes.agreement[compared] > 0]]
        pair = votes.pair[row]
        low, high = members[votes.low[pair]], members[votes.high[pair]]
        cost[row] = _cost(evidence, piece_from, low, high, votes.low_from_high[row], agreeing)
    return cost


def _cost(evidence: Evidence, piece_from: Floats, low: Ints, high: Ints, motion: Floats, joined: Ints) -> float:
    moved = motion @ piece_from[high]
    first = piece_from[low]
    apart = np.linalg.norm(first[:, None, :3, 3] - moved[None, :, :3, 3], axis=2)
    trace = first[:, :3, :3].reshape(-1, 9) @ moved[:, :3, :3].reshape(-1, 9).T
    facing = np.arccos(np.clip((trace - 1) / 2, -1, 1)) < WIDEST_ANGLE_RAD
    costs = np.where(facing, missing_cost(apart / evidence.reach_m), 0.0)
    ends = evidence.edges[joined]
    in_low = np.isin(ends[:, 0], low)
    a, b = np.where(in_low, ends[:, 0], ends[:, 1]), np.where(in_low, ends[:, 1], ends[:, 0])
    costs[np.searchsorted(low, a), np.searchsorted(high, b)] = 0.0
    return float(costs.sum())


def missing_cost(distance: Floats) -> Floats:
    """−log of the probability that views at this distance, in units of the reach, are not joined."""
    return np.asarray(-np.log1p(-JOINED * np.exp(-0.5 * (distance / RANGE) ** 4)))
