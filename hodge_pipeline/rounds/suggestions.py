"""Which pairs to register next: those whose edge would add the most information."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.spatial import cKDTree

from hodge_pipeline.diagnosis.result import UNTESTABLE, Diagnosis
from hodge_pipeline.solvers.resistance import Network
from hodge_pipeline.types import Bools, Floats, Ints, ViewGraph
from hodge_pipeline.types.text import counted

SUGGESTED = 12
"""Pairs that are suggested to a person, at most."""
NEAREST = 6
"""Nearest views of each view that are candidates, whatever edges there are."""
NEIGHBOURS_APART = 64
"""Places in the sorted list of a view's neighbours: two that are so near in it are candidates. All pairs of the
neighbours of one view would be as many as their number squared (24 GB for 50,000); views of 18 graphs have 2 to 61.
"""
TESTED_GAIN = 1.0
"""Nats added to the score for each untestable edge that becomes testable."""
DIGITS = 9
"""Of nats: pairs of equal worth come in order on every machine, not as it rounds."""
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
    most: int = SUGGESTED,
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
    if overlapping is None:
        overlapping = np.concatenate([_missing_sides(graph.edges[kept], count), _near(diagnosis)])
    inside = diagnosis.piece[overlapping[:, 0]] == diagnosis.piece[overlapping[:, 1]]
    breaks = np.flatnonzero(diagnosis.piece[1:] != diagnosis.piece[:-1])
    pairs = np.concatenate([overlapping[inside], np.stack([breaks, breaks + 1], axis=1)])
    low, high = np.sort(pairs, axis=1).T
    keys = np.unique(low * count + high)
    pairs = np.stack([keys // max(count, 1), keys % max(count, 1)], axis=1)
    pairs = pairs[pairs[:, 0] != pairs[:, 1]]
    registered = graph.edges if tried is None else np.concatenate([graph.edges, tried])
    pairs = pairs[~_contains(registered, pairs, count)]
    untestable = graph.edges[diagnosis.verdict == UNTESTABLE]
    return _best_first(pairs, graph.edges[kept], untestable, diagnosis.network, most)


def _missing_sides(edges: Ints, count: int) -> Ints:
    """Pairs (N, 2), i < j, with a common neighbour in whose list they are near each other; they may be joined
    themselves.
    """
    keys = np.unique(np.concatenate([edges @ [count, 1], edges @ [1, count]]))
    view, neighbour = keys // max(count, 1), keys % max(count, 1)
    parts = [np.zeros((0, 2), np.int64)]
    for apart in range(1, NEIGHBOURS_APART + 1):
        both = view[apart:] == view[:-apart]
        if not both.any():
            break
        parts.append(np.stack([neighbour[:-apart][both], neighbour[apart:][both]], axis=1))
    return np.concatenate(parts)


def _near(diagnosis: Diagnosis) -> Ints:
    """Each view with its nearest ones in the same piece."""
    parts = [np.zeros((0, 2), np.int64)]
    by_piece = np.argsort(diagnosis.piece, kind="stable")
    for rows in np.split(by_piece, np.bincount(diagnosis.piece).cumsum()[:-1]):
        if len(rows) < 2:
            break  # pieces come by size
        number = min(NEAREST + 1, len(rows))
        _, found = cKDTree(diagnosis.world_from_cam[rows, :3, 3]).query(diagnosis.world_from_cam[rows, :3, 3], number)
        parts.append(np.stack([np.repeat(rows, number), rows[found.ravel()]], axis=1))
    return np.concatenate(parts)


def _contains(edges: Ints, pairs: Ints, count: int) -> Bools:
    wanted, there = (np.sort(each, axis=1) @ [count, 1] for each in (pairs, edges))
    return np.isin(wanted, there)


def _best_first(pairs: Ints, kept: Ints, untestable: Ints, network: Network, most: int) -> Suggestions:
    """Greedy choice: the pair that adds most to the kept edges, then the one that adds most to these and the first, and
    so on; no view in more than `EACH_VERTEX` pairs.
    """
    resistance, taken, count = network.between(pairs), list[Floats](), len(network.component)
    pair, edge = _triangles(pairs, untestable, kept, count)
    is_open, free, named = np.ones(len(untestable)), np.ones(len(pairs), bool), np.zeros(count, np.int64)
    rows: list[int] = []
    gained: list[tuple[float, float, float]] = []
    while free.any() and len(rows) < most:
        tests = np.bincount(pair, is_open[edge], len(pairs))
        variance = np.where(np.isfinite(resistance), resistance, count)
        score = (np.log1p(variance) + TESTED_GAIN * tests).round(DIGITS)
        row = int(np.argmax(np.where(free, score, -np.inf)))
        rows.append(row)
        gained.append((float(score[row]), float(resistance[row]), float(tests[row])))
        named[pairs[row]] += 1
        free[row] = False
        free &= (named[pairs] < EACH_VERTEX).all(axis=1)
        is_open[edge[pair == row]] = 0
        if np.isfinite(resistance[row]):
            resistance = _with_pair(network, taken, pairs, row, resistance)
    score, resistance, tests = np.array(gained, float).reshape(-1, 3).T
    reason = np.array(_reasons(resistance, tests.astype(np.int64)), dtype=np.str_)
    return Suggestions(pairs[np.array(rows, np.int64)], score, resistance, tests.astype(np.int64), reason)


def _triangles(pairs: Ints, untestable: Ints, kept: Ints, count: int) -> tuple[Ints, Ints]:
    """Rows of pairs and of untestable edges that would be sides of one triangle, whose third side is kept."""
    found = [np.zeros((2, 0), np.int64)]
    for i, j in (pairs.T, pairs.T[::-1]):
        for a, k in (untestable.T, untestable.T[::-1]):
            rows = np.stack((_one_of_each(i, count) @ _one_of_each(a, count).T).nonzero()).astype(np.int64)
            found.append(rows[:, _contains(kept, np.stack([j[rows[0]], k[rows[1]]], axis=1), count)])
    pair, edge = np.concatenate(found, axis=1)
    return pair, edge


def _one_of_each(columns: Ints, count: int) -> csr_matrix:
    ones = np.ones(len(columns), np.int32)
    return csr_matrix((ones, (np.arange(len(columns)), columns)), shape=(len(columns), count))


def _with_pair(network: Network, taken: list[Floats], pairs: Ints, row: int, resistance: Floats) -> Floats:
    """The resistances (P,) with one pair more among those `taken`: variances fall by what it holds."""
    # L⁺ loses z zᵀ, z = L⁺ b / √(1 + bᵀ L⁺ b), by each pair taken (Sherman and Morrison 1950)
    i, j = pairs[row].tolist()
    held = network.potentials(i, j)
    for before in taken:
        held -= before * (before[i] - before[j])
    held /= np.sqrt(1 + resistance[row])
    taken.append(held)
    return np.maximum(resistance - (held[pairs[:, 0]] - held[pairs[:, 1]]) ** 2, 0.0)


def _reasons(resistance: Floats, tests: Ints) -> tuple[str, ...]:
    lines = []
    for value, number in zip(resistance.tolist(), tests.tolist(), strict=True):
        if not np.isfinite(value):
            text = "joins two pieces"
        else:
            after = np.sqrt(value / (1 + value))
            text = f"sigma between them falls from {np.sqrt(value):.2g} to {after:.2g} times one edge's"
        if number:
            text = f"tests {counted(number, 'untestable edge')}; {text}"
        lines.append(text)
    return tuple(lines)
