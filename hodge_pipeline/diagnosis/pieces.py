"""Align a scene from its edges: pieces are merged greedily, those with the largest log-evidence first.

Each round every piece picks the neighbour with the largest log-evidence and is merged with it, unless that neighbour
has much better merges of its own to come (Borůvka's scheme for trees, with patience). Once joined, all their
edges vote together, so that long cycles are tested without ever being listed. No edge is trusted: one that agrees with
no other is left out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.diagnosis.evidence import Evidence
from hodge_pipeline.diagnosis.votes import Votes, agreed_motions, collect_votes
from hodge_pipeline.types import Bools, Floats, Ints

TIE_BREAK = 1e-3
SINGLE_VOTE_FROM = 0.3
"""The weight from which one edge, which no other confirms, may join two pieces."""
PATIENCE = 0.7
"""Of the best score that a piece has: weaker merges wait, since more edges may then vote on their placement."""


@dataclass(frozen=True)
class Alignment:
    """The piece (V,) of each vertex, and its pose in the piece's frame (V, 4, 4)."""

    piece: Ints
    piece_from: Floats


def align(
    evidence: Evidence, weight: Floats, cluster_gain: float, rng: np.random.Generator, start: Alignment | None = None
) -> Alignment:
    """The alignment that these edge weights (E,) lead to, from vertices on their own or from the pieces of a start."""
    count = evidence.vertex_count
    piece, piece_from = np.arange(count), np.broadcast_to(np.eye(4), (count, 4, 4)).copy()
    if start is not None:
        piece, piece_from = start.piece.copy(), start.piece_from.copy()
    # without this, equal weights would join a chain one edge a round
    weight = weight * (1 + TIE_BREAK * rng.random(len(weight)))
    while (votes := collect_votes(evidence, piece, piece_from, weight)) is not None:
        gain = _gains(evidence, votes, weight, cluster_gain)
        joined, moves_low = _joins(votes, gain, count)
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
        piece_from[moving] = motions[step] @ piece_from[moving]
        piece[moving] = np.where(moves_low, high, low)[step]
    return Alignment(piece, piece_from)


def _gains(evidence: Evidence, votes: Votes, weight: Floats, cluster_gain: float) -> Floats:
    """Log-evidence (nats) for each hypothesis (N,): the weights of the edges that agree, and a term that grows with
    the logarithm of their number. 0 for a vote that is no hypothesis, or may not join two pieces on its own.
    """
    size = len(votes.edge)
    strength = votes.agreement * weight[votes.edge[votes.vote]]
    counted = votes.agreement * np.minimum(1.0, 0.5 + weight[votes.edge[votes.vote]])
    gain: Floats = np.bincount(votes.hypothesis, strength, size).astype(np.float64)
    gain += cluster_gain * np.log1p(np.bincount(votes.hypothesis, counted, size))
    agreeing = np.bincount(votes.hypothesis, votes.agreement > 0, size)
    suffices: Bools = evidence.in_no_listed_cycle[votes.edge] | (weight[votes.edge] > SINGLE_VOTE_FROM)
    return np.where((agreeing >= 2) | ((agreeing == 1) & suffices), gain, 0.0)


def _joins(votes: Votes, gain: Floats, count: int) -> tuple[Ints, Bools]:
    """The hypotheses to join by, and whether it is the lower of the two pieces that moves.

    A piece moves to the one with the largest log-evidence, if that one stays where it is in this round and has no much
    better join of its own to wait for.
    """
    order = np.lexsort((-gain, votes.pair))
    best = order[votes.start]
    real = np.flatnonzero(gain[best] > 0)
    real = real[np.lexsort((real, -gain[best][real]))]
    low, high, score = votes.low[real], votes.high[real], gain[best][real]
    first = np.full(count, len(real))
    np.minimum.at(first, low, np.arange(len(real)))
    np.minimum.at(first, high, np.arange(len(real)))
    chosen, moves_low = [], []
    has_moved, base = np.zeros(count, bool), np.zeros(count, bool)
    for row in np.unique(first[first < len(real)]).tolist():
        for mover, other, lower in ((high[row], low[row], False), (low[row], high[row], True)):
            wanted = first[mover] == row and score[row] >= PATIENCE * score[first[other]]
            if wanted and not (has_moved[mover] or base[mover] or has_moved[other]):
                has_moved[mover] = base[other] = True
                chosen.append(real[row])
                moves_low.append(lower)
    return best[np.array(chosen, np.int64)], np.array(moves_low, bool)
