"""Edges between pieces as votes on where one piece lies in the other, and how many agree on each vote."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.diagnosis.evidence import Evidence
from hodge_pipeline.types import Bools, Floats, Ints

GATE = 30.0
"""χ² over six dimensions of two votes: beyond it they do not agree. Generous, since tails are heavy."""
HYPOTHESES = 24
"""Votes of a pair of pieces, the weightiest, that are tried as the answer."""
MOST_PAIRS_TO_A_VOTE = 400
DRIFT = 0.25
"""Of an edge's variance, for each usual edge length between two votes: pieces are not solved while they grow."""


@dataclass(frozen=True)
class Votes:
    """Votes sorted by the pair of pieces that they join, weightiest first; hypotheses are some of them.

    - `edge (N,)`, `low_from_high (N, 4, 4)`: where the edge puts the piece of higher number; `point (N, 3)`: the end
      of the edge in that piece.
    - `pair (N,)`: row of the pair of pieces; `low`, `high (P,)`: their numbers; `start`, `count (P,)`: its votes.
    - `hypothesis`, `vote (M,)`: rows that were compared; `agreement (M,)` from 1 down to 0 at the gate.
    """

    edge: Ints
    low_from_high: Floats
    point: Floats
    pair: Ints
    low: Ints
    high: Ints
    start: Ints
    count: Ints
    hypothesis: Ints
    vote: Ints
    agreement: Floats


def collect_votes(evidence: Evidence, piece: Ints, piece_from: Floats, weight: Floats) -> Votes | None:
    """The votes of all edges between two pieces; None where there is none."""
    edge = np.flatnonzero(piece[evidence.edges[:, 0]] != piece[evidence.edges[:, 1]])
    if not len(edge):
        return None
    tail, head = evidence.edges[edge].T
    swapped = piece[tail] > piece[head]
    motion = piece_from[tail] @ evidence.i_from_j[edge] @ se3.inverse(piece_from[head])
    motion[swapped] = se3.inverse(motion[swapped])
    point = piece_from[np.where(swapped, tail, head), :3, 3]
    low, high = np.minimum(piece[tail], piece[head]), np.maximum(piece[tail], piece[head])
    key = low * evidence.vertex_count + high
    order = np.lexsort((-weight[edge], key))
    edge, motion, point, key = edge[order], motion[order], point[order], key[order]
    names, start, pair, count = np.unique(key, return_index=True, return_inverse=True, return_counts=True)
    hypothesis, vote = _compared(pair.reshape(-1), start, count)
    agreement = agreement_of(evidence, edge, motion, point, hypothesis, vote)
    low, high = names // evidence.vertex_count, names % evidence.vertex_count
    return Votes(edge, motion, point, pair.reshape(-1), low, high, start, count, hypothesis, vote, agreement)


def _compared(pair: Ints, start: Ints, count: Ints) -> tuple[Ints, Ints]:
    """Each of a pair's first votes with all of its votes, or with evenly spread ones where they are very many."""
    rank = np.arange(len(pair)) - start[pair]
    hypothesis = np.flatnonzero(rank < HYPOTHESES)
    total = count[pair[hypothesis]]
    taken = np.minimum(total, MOST_PAIRS_TO_A_VOTE)
    row = np.repeat(np.arange(len(hypothesis)), taken)
    number = np.arange(len(row)) - np.repeat(np.cumsum(taken) - taken, taken)
    return hypothesis[row], start[pair[hypothesis]][row] + number * total[row] // taken[row]


def agreement_of(evidence: Evidence, edge: Ints, motion: Floats, point: Floats, first: Ints, second: Ints) -> Floats:
    """How well pairs (M,) of votes (N,) agree, from 1 down to 0 at the gate: rows `first` and `second` of the edges,
    their motions (N, 4, 4) and the points (N, 3) that these move.
    """
    quat = se3.to_quat_xyzw(motion)
    angle = 2 * np.arccos(np.minimum(1.0, np.abs(np.einsum("ni,ni->n", quat[first], quat[second]))))
    at = point[second]
    difference = motion[first, :3, :3] - motion[second, :3, :3]
    moved = np.einsum("nij,nj->ni", difference, at) + motion[first, :3, 3] - motion[second, :3, 3]
    apart = np.einsum("ni,ni->n", at - point[first], at - point[first])
    turn = evidence.noise.rotation_rad[edge] ** 2
    shift = evidence.noise.translation_m[edge] ** 2
    slack = 1 + DRIFT * np.sqrt(apart) / evidence.reach_m
    turn_both = (turn[first] + turn[second]) * slack
    shift_both = (shift[first] + shift[second]) * slack + turn[first] * apart
    chi2 = angle**2 / turn_both + np.einsum("ni,ni->n", moved, moved) / shift_both
    return np.asarray(np.maximum(0.0, 1 - chi2 / GATE))


def agreed_motions(votes: Votes, chosen: Ints, weight: Floats) -> Floats:
    """The mean (K, 4, 4) of the votes that agree with each chosen hypothesis, one to a pair of pieces."""
    place = np.full(len(votes.edge), -1, np.int64)
    place[chosen] = np.arange(len(chosen))
    used: Bools = (place[votes.hypothesis] >= 0) & (votes.agreement > 0)
    row, vote = place[votes.hypothesis[used]], votes.vote[used]
    share = votes.agreement[used] * weight[votes.edge[vote]]
    total = np.bincount(row, share, len(chosen))
    moved = np.einsum("nij,nj->ni", votes.low_from_high[vote, :3, :3], votes.point[vote])
    moved += votes.low_from_high[vote, :3, 3]
    rotation = se3.project_to_so3(_sums(row, share, votes.low_from_high[vote, :3, :3], len(chosen)))
    landed = _sums(row, share, moved, len(chosen)) / total[:, None]
    middle = _sums(row, share, votes.point[vote], len(chosen)) / total[:, None]
    return se3.from_parts(rotation, landed - np.einsum("nij,nj->ni", rotation, middle))


def mean_motion(motion: Floats, point: Floats, share: Floats) -> Floats:
    """The mean (4, 4) of motions (n, 4, 4) by where they bring their points (n, 3), each counting its share (n,)."""
    share = share / share.sum()
    rotation = se3.project_to_so3(np.einsum("n,nab->ab", share, motion[:, :3, :3])[None])[0]
    landed = share @ (np.einsum("nab,nb->na", motion[:, :3, :3], point) + motion[:, :3, 3])
    return np.asarray(se3.from_parts(rotation, landed - rotation @ (share @ point)))


def _sums(row: Ints, share: Floats, values: Floats, count: int) -> Floats:
    flat = values.reshape(len(values), -1) * share[:, None]
    columns = [np.bincount(row, column, count) for column in flat.T]
    return np.stack(columns, axis=1).astype(np.float64).reshape(count, *values.shape[1:])
