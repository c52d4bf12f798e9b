"""Align a scene from its edges: pieces grow together where most edges agree on how, best first.

Each round every piece picks the neighbour that the agreeing edges speak for most; where two pick each other they are
joined (Borůvka's scheme for trees). Once joined, all their edges vote together, so that long cycles are tested without
ever being listed. No edge is trusted: one that agrees with nothing is simply left out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hodge_pipeline.diagnosis.evidence import Evidence
from hodge_pipeline.diagnosis.votes import Votes, agreed_motions, collect_votes
from hodge_pipeline.types import Bools, Floats, Ints

TIE_BREAK = 1e-3
SINGLE_VOTE_FROM = 0.3
"""The weight from which one edge, which no other confirms, may join two pieces."""


@dataclass(frozen=True)
class Alignment:
    """The piece (V,) of each vertex, and its pose in the piece's frame (V, 4, 4)."""

    piece: Ints
    piece_from: Floats


def align(evidence: Evidence, weight: Floats, cluster_gain: float, rng: np.random.Generator) -> Alignment:
    """The alignment that these edge weights (E,) lead to."""
    count = evidence.vertex_count
    piece, piece_from = np.arange(count), np.broadcast_to(np.eye(4), (count, 4, 4)).copy()
    # without this, equal weights would join a chain one edge a round
    weight = weight * (1 + TIE_BREAK * rng.random(len(weight)))
    while (votes := collect_votes(evidence, piece, piece_from, weight)) is not None:
        gain = _gains(evidence, votes, weight, cluster_gain)
        joined = _joins(votes, gain, count)
        if not len(joined):
            break
        motions = agreed_motions(votes, joined, weight)
        pair = votes.pair[joined]
        into = np.full(count, -1, np.int64)
        into[votes.high[pair]] = np.arange(len(pair))
        moving = np.flatnonzero(into[piece] >= 0)
        step = into[piece[moving]]
        piece_from[moving] = motions[step] @ piece_from[moving]
        piece[moving] = votes.low[pair][step]
    return Alignment(piece, piece_from)


def _gains(evidence: Evidence, votes: Votes, weight: Floats, cluster_gain: float) -> Floats:
    """What speaks for each hypothesis (N,), in nats: the weights of the edges that agree, and a term that grows with
    the logarithm of their number. 0 for a vote that is no hypothesis, or may not join two pieces on its own.
    """
    size = len(votes.edge)
    strength = votes.agreement * weight[votes.edge[votes.vote]]
    counted = votes.agreement * np.minimum(1.0, 0.5 + weight[votes.edge[votes.vote]])
    gain: Floats = np.bincount(votes.hypothesis, strength, size).astype(np.float64)
    gain += cluster_gain * np.log1p(np.bincount(votes.hypothesis, counted, size))
    agreeing = np.bincount(votes.hypothesis, votes.agreement > 0, size)
    alone: Bools = evidence.alone[votes.edge] | (weight[votes.edge] > SINGLE_VOTE_FROM)
    return np.where((agreeing >= 2) | ((agreeing == 1) & alone), gain, 0.0)


def _joins(votes: Votes, gain: Floats, count: int) -> Ints:
    """The hypotheses whose two pieces choose each other: the best of a pair, and the best pair of both pieces."""
    order = np.lexsort((-gain, votes.pair))
    best = order[votes.start]
    score = gain[best]
    real = np.flatnonzero(score > 0)
    real = real[np.lexsort((real, -score[real]))]
    rank = np.arange(len(real))
    first = np.full(count, len(real))
    np.minimum.at(first, votes.low[real], rank)
    np.minimum.at(first, votes.high[real], rank)
    mutual = (first[votes.low[real]] == rank) & (first[votes.high[real]] == rank)
    return np.asarray(best[real[mutual]])
