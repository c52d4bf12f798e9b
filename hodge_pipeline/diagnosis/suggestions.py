"""Which pairs to register next: those whose edge would tell, or hold, the most."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_matrix
from scipy.spatial import cKDTree

from hodge_pipeline.diagnosis.resistance import effective_resistance
from hodge_pipeline.diagnosis.result import UNTESTABLE, Diagnosis
from hodge_pipeline.types import Bools, Floats, Ints, ViewGraph

NEAREST = 6
"""Nearest views of each view that are candidates, whatever the graph says."""
TESTED_GAIN = 1.0
"""What an untestable edge that becomes testable counts, in nats, beside the logarithm of the variance saved."""
EACH_VERTEX = 2
"""Suggestions that share a view tell much the same."""


@dataclass(frozen=True)
class Suggestions:
    """Pairs (K, 2) of vertex rows to register, the most telling first, and why.

    - `score (K,)` nats: the log-determinant that an edge adds, and what it tests.
    - `resistance (K,)`: the variance of the pair's relative pose in units of an edge's; ∞ between pieces.
    - `tests (K,)`: how many untestable edges it would put into a triangle.
    """

    pairs: Ints
    score: Floats
    resistance: Floats
    tests: Ints
    reason: tuple[str, ...]


def suggest_pairs(graph: ViewGraph, diagnosis: Diagnosis, most: int = 20) -> Suggestions:
    """The most telling pairs that no kept edge joins yet, ranked; each view occurs at most twice.

    Candidates are the missing sides of triangles, views that lie near each other, and neighbours in order that lie in
    different pieces.
    """
    count, kept = graph.vertex_count, np.flatnonzero(diagnosis.kept)
    joined = _adjacency(graph.edges[kept], count)
    pairs = np.concatenate([_missing_sides(joined), _near(diagnosis), _across_pieces(diagnosis.piece)], axis=0)
    low, high = np.sort(pairs, axis=1).T
    keys = np.unique(low * count + high)
    pairs = np.stack([keys // count, keys % count], axis=1)
    pairs = pairs[pairs[:, 0] != pairs[:, 1]]
    pairs = pairs[~_contains(graph.edges[kept], pairs, count)]
    tests = _tested(graph.edges[diagnosis.verdict == UNTESTABLE], joined, pairs)
    resistance = _resistance(graph.edges[kept], pairs, count)
    score = np.log1p(np.where(np.isfinite(resistance), resistance, count)) + TESTED_GAIN * tests
    order = np.lexsort((np.arange(len(pairs)), -score))
    chosen = order[_first_of_each(pairs[order], count)][:most]
    return Suggestions(
        pairs[chosen], score[chosen], resistance[chosen], tests[chosen], _reasons(resistance[chosen], tests[chosen])
    )


def _adjacency(edges: Ints, count: int) -> csr_matrix:
    proper = edges[edges[:, 0] != edges[:, 1]]
    ends = np.concatenate([proper, proper[:, ::-1]])
    matrix = csr_matrix((np.ones(len(ends), np.int32), (ends[:, 0], ends[:, 1])), shape=(count, count))
    matrix.data[:] = 1
    return matrix


def _missing_sides(joined: csr_matrix) -> Ints:
    """Pairs (N, 2), i < j, with a common neighbour; they may be joined themselves."""
    twice = (joined @ joined).tocoo()
    above = twice.row < twice.col
    return np.stack([twice.row[above], twice.col[above]], axis=1).astype(np.int64)


def _near(diagnosis: Diagnosis) -> Ints:
    """Each view with its nearest ones in the same piece."""
    parts = [np.zeros((0, 2), np.int64)]
    for piece in range(int(diagnosis.piece.max(initial=-1)) + 1):
        rows = np.flatnonzero(diagnosis.piece == piece)
        if len(rows) < 2:
            break  # pieces come by size
        known = min(NEAREST + 1, len(rows))
        _, found = cKDTree(diagnosis.world_from_cam[rows, :3, 3]).query(diagnosis.world_from_cam[rows, :3, 3], known)
        parts.append(np.stack([np.repeat(rows, known), rows[found.ravel()]], axis=1))
    return np.concatenate(parts)


def _across_pieces(piece: Ints) -> Ints:
    breaks = np.flatnonzero(piece[1:] != piece[:-1])
    return np.stack([breaks, breaks + 1], axis=1).astype(np.int64)


def _contains(edges: Ints, pairs: Ints, count: int) -> Bools:
    low, high = np.sort(edges, axis=1).T
    return np.isin(pairs[:, 0] * count + pairs[:, 1], low * count + high)


def _tested(untestable: Ints, joined: csr_matrix, pairs: Ints) -> Ints:
    """How many untestable edges (K,) would have a triangle with each pair and one joined side."""
    if not len(untestable) or not len(pairs):
        return np.zeros(len(pairs), np.int64)
    alone = _adjacency(untestable, joined.shape[0])
    i, j = pairs.T
    # a common neighbour k over one untestable and one joined edge; both untestable counts both
    through = np.asarray(alone[i].multiply(joined[j]).sum(axis=1)).ravel()
    through += np.asarray(joined[i].multiply(alone[j]).sum(axis=1)).ravel()
    return np.asarray(through, np.int64)


def _resistance(edges: Ints, pairs: Ints, count: int) -> Floats:
    both = np.concatenate([edges, pairs])
    used = np.arange(len(both)) < len(edges)
    return effective_resistance(both, count, used)[len(edges) :]


def _first_of_each(pairs: Ints, count: int) -> Ints:
    """The places of the pairs, in order, that come before their views have been named often enough."""
    named = np.zeros(count, np.int64)
    out = []
    for place, (i, j) in enumerate(pairs.tolist()):
        if max(named[i], named[j]) < EACH_VERTEX:
            named[i] += 1
            named[j] += 1
            out.append(place)
    return np.array(out, np.int64)


def _reasons(resistance: Floats, tests: Ints) -> tuple[str, ...]:
    lines = []
    for value, number in zip(resistance.tolist(), tests.tolist(), strict=True):
        if not np.isfinite(value):
            text = "joins two pieces"
        else:
            text = f"its ends are known to {np.sqrt(value):.2g} of an edge's deviation; an edge leaves "
            text += f"{np.sqrt(value / (1 + value)):.2g}"
        if number:
            text = f"tests {number} untestable edge{'s' if number > 1 else ''}; {text}"
        lines.append(text)
    return tuple(lines)
