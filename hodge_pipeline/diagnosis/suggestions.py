"""Which pairs to register next: those whose edge would add the most information."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.spatial import cKDTree

from hodge_pipeline.diagnosis.resistance import Network
from hodge_pipeline.diagnosis.result import UNTESTABLE, Diagnosis
from hodge_pipeline.types import Bools, Floats, Ints, ViewGraph

NEAREST = 6
"""Nearest views of each view that are candidates, whatever edges there are."""
TESTED_GAIN = 1.0
"""Nats for each untestable edge that becomes testable, added to the logarithm of the variance saved."""
EACH_VERTEX = 2
"""Suggestions that share a view add nearly the same information."""


@dataclass(frozen=True)
class Suggestions:
    """Pairs (K, 2) of vertex rows to register, the most informative first, and why.

    - `score (K,)` nats: the log-determinant that an edge adds, and what it tests.
    - `resistance (K,)`: the variance of the pair's relative pose in units of an edge's; ∞ between pieces.
    - `tests (K,)`: how many untestable edges it would put into a triangle.
    """

    pairs: Ints
    score: Floats
    resistance: Floats
    tests: Ints
    reason: NDArray[np.str_]

    def select(self, rows: Bools) -> Suggestions:
        """These only, in this order."""
        return Suggestions(*(getattr(self, field.name)[rows] for field in fields(self)))


def suggest_pairs(
    graph: ViewGraph,
    diagnosis: Diagnosis,
    most: int = 20,
    *,
    overlapping: Ints | None = None,
    tried: Ints | None = None,
) -> Suggestions:
    """The most informative pairs that no kept edge joins yet, ranked; each view occurs at most twice.

    Candidates are the pairs (N, 2) that see something in common, `overlapping`; where that is not known, the missing
    sides of triangles and views that lie near each other. And neighbours in order that lie in different pieces. Pairs
    that were `tried` in vain are left out.
    """
    count, kept = graph.vertex_count, np.flatnonzero(diagnosis.kept)
    joined = _adjacency(graph.edges[kept], count)
    inside = np.concatenate([_missing_sides(joined), _near(diagnosis)]) if overlapping is None else overlapping
    inside = inside[diagnosis.piece[inside[:, 0]] == diagnosis.piece[inside[:, 1]]]
    pairs = np.concatenate([inside, _across_pieces(diagnosis.piece)])
    low, high = np.sort(pairs, axis=1).T
    keys = np.unique(low * count + high)
    pairs = np.stack([keys // max(count, 1), keys % max(count, 1)], axis=1)
    pairs = pairs[pairs[:, 0] != pairs[:, 1]]
    registered = graph.edges if tried is None else np.concatenate([graph.edges, tried])
    pairs = pairs[~_contains(registered, pairs, count)]
    gains = _Gains.of(graph.edges[kept], graph.edges[diagnosis.verdict == UNTESTABLE], pairs, count)
    return _best_first(pairs, gains, most)


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
        number = min(NEAREST + 1, len(rows))
        _, found = cKDTree(diagnosis.world_from_cam[rows, :3, 3]).query(diagnosis.world_from_cam[rows, :3, 3], number)
        parts.append(np.stack([np.repeat(rows, number), rows[found.ravel()]], axis=1))
    return np.concatenate(parts)


def _across_pieces(piece: Ints) -> Ints:
    breaks = np.flatnonzero(piece[1:] != piece[:-1])
    return np.stack([breaks, breaks + 1], axis=1).astype(np.int64)


def _contains(edges: Ints, pairs: Ints, count: int) -> Bools:
    low, high = np.sort(edges, axis=1).T
    return np.isin(pairs[:, 0] * count + pairs[:, 1], low * count + high)


class _Gains:
    """What an edge of each pair would add to the kept edges and to the pairs taken so far."""

    def __init__(self, joined: csr_matrix, untestable: csr_matrix, network: Network, pairs: Ints) -> None:
        self._joined, self._untestable, self._network, self._pairs = joined, untestable, network, pairs
        self._taken: list[Floats] = []
        self.resistance = network.between(pairs)
        self.tests = self._tested(np.arange(len(pairs)))

    @classmethod
    def of(cls, kept: Ints, untestable: Ints, pairs: Ints, count: int) -> _Gains:
        """Those of these pairs beside the kept edges."""
        return cls(_adjacency(kept, count), _adjacency(untestable, count), Network.of(kept, count), pairs)

    @property
    def score(self) -> Floats:
        """Nats of each pair."""
        count = self._joined.shape[0]
        finite_resistance = np.where(np.isfinite(self.resistance), self.resistance, count)
        return np.asarray(np.log1p(finite_resistance) + TESTED_GAIN * self.tests)

    def take(self, row: int) -> None:
        """Count the pair among the edges: the variances fall by what it holds, and what it tests is tested."""
        i, j = self._pairs[row].tolist()
        if self.tests[row]:
            self._test(i, j)
        if np.isfinite(self.resistance[row]):
            # L⁺ loses z zᵀ, z = L⁺ b / √(1 + bᵀ L⁺ b), by each pair taken (Sherman and Morrison 1950)
            held = self._network.potentials(i, j)
            for before in self._taken:
                held -= before * (before[i] - before[j])
            held /= np.sqrt(1 + self.resistance[row])
            self._taken.append(held)
            falls = (held[self._pairs[:, 0]] - held[self._pairs[:, 1]]) ** 2
            self.resistance = np.maximum(self.resistance - falls, 0.0)

    def _test(self, i: int, j: int) -> None:
        untestable, joined = self._untestable.tolil(), self._joined
        touched = {i, j}
        for a, b in ((i, j), (j, i)):
            for k in self._untestable[a].multiply(joined[b]).indices.tolist():
                untestable[a, k] = untestable[k, a] = 0
                untestable[b, k] = untestable[k, b] = 0
                touched.add(k)
        self._untestable = untestable.tocsr()
        self._untestable.eliminate_zeros()
        again = np.flatnonzero(np.isin(self._pairs, list(touched)).any(axis=1))
        self.tests[again] = self._tested(again)

    def _tested(self, rows: Ints) -> Ints:
        """How many untestable edges would have a triangle with each pair (K,) and one joined side."""
        if not self._untestable.nnz or not len(rows):
            return np.zeros(len(rows), np.int64)
        i, j = self._pairs[rows].T
        # a common neighbour k over one untestable and one joined edge; both untestable counts both
        through = np.asarray(self._untestable[i].multiply(self._joined[j]).sum(axis=1)).ravel()
        through += np.asarray(self._joined[i].multiply(self._untestable[j]).sum(axis=1)).ravel()
        return np.asarray(through, np.int64)


def _best_first(pairs: Ints, gains: _Gains, most: int) -> Suggestions:
    """The pair that adds most, then the one that adds most to it, and so on; none whose views were named too often."""
    named = np.zeros(int(pairs.max(initial=-1)) + 1, np.int64)
    free = np.ones(len(pairs), bool)
    rows: list[int] = []
    gained: list[tuple[float, float, int]] = []
    while free.any() and len(rows) < most:
        score = np.where(free, gains.score, -np.inf)
        row = int(np.argmax(score))
        rows.append(row)
        gained.append((float(score[row]), float(gains.resistance[row]), int(gains.tests[row])))
        named[pairs[row]] += 1
        free[row] = False
        free &= (named[pairs] < EACH_VERTEX).all(axis=1)
        gains.take(row)
    score, resistance, tests = np.array(gained, float).reshape(-1, 3).T
    reason = np.array(_reasons(resistance, tests.astype(np.int64)), dtype=np.str_)
    return Suggestions(pairs[np.array(rows, np.int64)], score, resistance, tests.astype(np.int64), reason)


def _reasons(resistance: Floats, tests: Ints) -> tuple[str, ...]:
    lines = []
    for value, number in zip(resistance.tolist(), tests.tolist(), strict=True):
        if not np.isfinite(value):
            text = "joins two pieces"
        else:
            after = np.sqrt(value / (1 + value))
            text = f"the deviation between the two falls from {np.sqrt(value):.2g} to {after:.2g} of one edge's"
        if number:
            text = f"tests {number} untestable edge{'s' if number > 1 else ''}; {text}"
        lines.append(text)
    return tuple(lines)
