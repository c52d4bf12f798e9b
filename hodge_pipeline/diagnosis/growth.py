"""Align a scene from its edges: pieces are merged greedily, those with the largest log-evidence first.

Each round every piece picks the neighbour with the largest log-evidence and is merged with it (Borůvka's spanning
tree). Edges between two pieces are votes on their relative pose. Once two pieces are merged, all edges of both vote
together, so that long cycles are tested without being listed. No edge is trusted: one that agrees with no other is left
out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_matrix

from hodge_pipeline import se3
from hodge_pipeline.diagnosis.cycles import CLOSES_BELOW
from hodge_pipeline.diagnosis.evidence import Evidence
from hodge_pipeline.types import Bools, Floats, Ints

HYPOTHESES = 24
"""Votes of a pair of pieces, those of most weight, that are tried as hypotheses."""
MOST_COMPARED = 400
"""Votes of a pair of pieces that each hypothesis is compared with: a limit on cost."""
PER_FOLD = 2.0
"""Log-evidence, in nats per e-fold of their number, of edges between two sets of views that agree: not proportional to
it, since places that look alike give many wrong edges that agree.
"""


@dataclass(frozen=True)
class Alignment:
    """The piece (V,) of each vertex, and its pose in the piece's frame (V, 4, 4)."""

    piece: Ints
    poses: Floats


def align(evidence: Evidence, start: Alignment | None = None, along: Bools | bool = True) -> Alignment:
    """The alignment by greedy merging, of single vertices or of the pieces of a start; `along (E,)`: by these edges."""
    count, weight = evidence.graph.vertex_count, evidence.weight
    piece, poses = np.arange(count), np.broadcast_to(np.eye(4), (count, 4, 4)).copy()
    if start is not None:
        piece, poses = start.piece.copy(), start.poses.copy()
    while (votes := collect_votes(evidence, piece, poses, along)) is not None:
        joined, moves_low = _joins(votes, _gains(evidence, votes), count)
        if not len(joined):
            break
        motions = agreed_motions(votes, joined, weight)
        motions[moves_low] = se3.inverse(motions[moves_low])
        pair = votes.pair[joined]
        low, high = votes.low[pair], votes.high[pair]
        into = np.full(count, -1, np.int64)
        into[np.where(moves_low, low, high)] = np.arange(len(pair))
        moving = np.flatnonzero(into[piece] >= 0)
        step = into[piece[moving]]
        poses[moving] = motions[step] @ poses[moving]
        piece[moving] = np.where(moves_low, high, low)[step]
    return Alignment(piece, poses)


def _gains(evidence: Evidence, votes: Votes) -> Floats:
    """Log-evidence (nats) for each hypothesis (N,): the weights of the edges that agree, and a term that grows with
    the logarithm of their number. 0 for a vote that is no hypothesis.
    """
    size, weight = len(votes.edge), evidence.weight
    strength = votes.agreement * weight[votes.edge[votes.vote]]
    counted = votes.agreement * np.minimum(1.0, 0.5 + weight[votes.edge[votes.vote]])
    gain = np.bincount(votes.hypothesis, strength, size)
    return np.asarray(gain + PER_FOLD * np.log1p(np.bincount(votes.hypothesis, counted, size)))


def _joins(votes: Votes, gain: Floats, count: int) -> tuple[Ints, Bools]:
    """The hypotheses (rows) to merge pieces by, and whether the piece of lower number moves.

    A piece moves to the one with the largest log-evidence, if that one stays where it is in this round.
    """
    order = np.lexsort((-gain, votes.pair))
    best = order[votes.start]
    real = np.flatnonzero(gain[best] > 0)
    real = real[np.lexsort((real, -gain[best][real]))]
    low, high = votes.low[real], votes.high[real]
    first = np.full(count, len(real))
    np.minimum.at(first, low, np.arange(len(real)))
    np.minimum.at(first, high, np.arange(len(real)))
    chosen, moves_low = [], []
    has_moved, base = np.zeros(count, bool), np.zeros(count, bool)
    for row in np.unique(first[first < len(real)]).tolist():
        for mover, other, lower in ((high[row], low[row], False), (low[row], high[row], True)):
            if first[mover] == row and not (base[mover] or has_moved[other]):
                has_moved[mover] = base[other] = True
                chosen.append(real[row])
                moves_low.append(lower)
    return best[np.array(chosen, np.int64)], np.array(moves_low, bool)


@dataclass(frozen=True)
class Votes:
    """Edges between pieces as votes on relative poses, sorted by pair of pieces and then by weight.

    - `edge (N,)`; `low_from_high (N, 4, 4)`: the relative pose of the pieces by the edge; `point (N, 3)`: the end of
      the edge in the piece of higher number, in that piece's frame.
    - `pair (N,)`: row of the pair of pieces; `low`, `high (P,)`: their numbers; `start (P,)`: first vote of each pair.
    - `hypothesis`, `vote (M,)`: rows that were compared; `agreement (M,)`: 1 where equal, down to 0 at the gate.
    """

    edge: Ints
    low_from_high: Floats
    point: Floats
    pair: Ints
    low: Ints
    high: Ints
    start: Ints
    hypothesis: Ints
    vote: Ints
    agreement: Floats


def collect_votes(evidence: Evidence, piece: Ints, piece_from: Floats, along: Bools | bool) -> Votes | None:
    """The votes of the edges `along (E,)` between two pieces; None where there is none."""
    edge = np.flatnonzero(along & np.not_equal(*piece[evidence.graph.edges.T]))
    if not len(edge):
        return None
    tail, head = evidence.graph.edges[edge].T
    swapped = piece[tail] > piece[head]
    motion = piece_from[tail] @ evidence.graph.i_from_j[edge] @ se3.inverse(piece_from[head])
    motion[swapped] = se3.inverse(motion[swapped])
    point = piece_from[np.where(swapped, tail, head), :3, 3]
    low, high = np.minimum(piece[tail], piece[head]), np.maximum(piece[tail], piece[head])
    key = low * evidence.graph.vertex_count + high
    order = np.lexsort((-evidence.weight[edge], key))
    edge, motion, point, key = edge[order], motion[order], point[order], key[order]
    names, start, pair, count = np.unique(key, return_index=True, return_inverse=True, return_counts=True)
    hypothesis, vote = _compared(pair.reshape(-1), start, count)
    agreement = agreement_of(evidence, edge, motion, point, hypothesis, vote)
    low, high = names // evidence.graph.vertex_count, names % evidence.graph.vertex_count
    return Votes(edge, motion, point, pair.reshape(-1), low, high, start, hypothesis, vote, agreement)


def _compared(pair: Ints, start: Ints, count: Ints) -> tuple[Ints, Ints]:
    """Each of a pair's first votes with all of its votes, or with evenly spread ones where they are very many."""
    rank = np.arange(len(pair)) - start[pair]
    hypothesis = np.flatnonzero(rank < HYPOTHESES)
    total = count[pair[hypothesis]]
    taken = np.minimum(total, MOST_COMPARED)
    row = np.repeat(np.arange(len(hypothesis)), taken)
    number = np.arange(len(row)) - np.repeat(np.cumsum(taken) - taken, taken)
    return hypothesis[row], start[pair[hypothesis]][row] + number * total[row] // taken[row]


def agreement_of(evidence: Evidence, edge: Ints, motion: Floats, point: Floats, first: Ints, second: Ints) -> Floats:
    """How well votes `first` and `second` (M,) agree: max(0, 1 − χ² / gate); by `edge (N,)`, `motion (N, 4, 4)` and
    `point (N, 3)`, that the motion acts on, of each vote.
    """
    quat = se3.to_quat_xyzw(motion)
    angle = 2 * np.arccos(np.minimum(1.0, np.abs(np.einsum("ni,ni->n", quat[first], quat[second]))))
    at = point[second]
    difference = motion[first, :3, :3] - motion[second, :3, :3]
    moved = np.einsum("nij,nj->ni", difference, at) + motion[first, :3, 3] - motion[second, :3, 3]
    apart = np.einsum("ni,ni->n", at - point[first], at - point[first])
    turn = evidence.noise.rotation_rad[edge] ** 2
    shift = evidence.noise.translation_m[edge] ** 2
    shift_both = shift[first] + shift[second] + turn[first] * apart
    chi2 = angle**2 / (turn[first] + turn[second]) + np.einsum("ni,ni->n", moved, moved) / shift_both
    return np.asarray(np.maximum(0.0, 1 - chi2 / CLOSES_BELOW))


def agreed_motions(votes: Votes, chosen: Ints, weight: Floats) -> Floats:
    """The mean (K, 4, 4) of the votes that agree with each chosen hypothesis, one to a pair of pieces."""
    place = np.full(len(votes.edge), -1, np.int64)
    place[chosen] = np.arange(len(chosen))
    used: Bools = (place[votes.hypothesis] >= 0) & (votes.agreement > 0)
    row, vote = place[votes.hypothesis[used]], votes.vote[used]
    share = votes.agreement[used] * weight[votes.edge[vote]]
    return mean_motions(row, votes.low_from_high[vote], votes.point[vote], share, len(chosen))


def mean_motions(group: Ints, motion: Floats, point: Floats, share: Floats, count: int) -> Floats:
    """Weighted means (count, 4, 4) of the motions (n, 4, 4) of each group (n,): the chordal mean of rotations, and the
    translation that fits where the motions take their points (n, 3); `share (n,)` are the weights.
    """
    share = share / np.bincount(group, share, count)[group]
    to_group = csr_matrix((share, (group, np.arange(len(group)))), shape=(count, len(group)))
    rotation = se3.project_to_so3((to_group @ motion[:, :3, :3].reshape(-1, 9)).reshape(-1, 3, 3))
    landed = to_group @ (np.einsum("nij,nj->ni", motion[:, :3, :3], point) + motion[:, :3, 3])
    return se3.from_parts(rotation, landed - np.einsum("nij,nj->ni", rotation, to_group @ point))
