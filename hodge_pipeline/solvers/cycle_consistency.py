"""A score of corruption for each edge before any solve, from its short cycles: triangles and pairs of parallel edges.

Cycle-edge message passing (Lerman and Shi 2022): an edge is as bad as the cycles whose other edges are good.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.complex.cech import flag_complex, orient_edges
from hodge_pipeline.types import Floats, Ints

ROUNDS = 12
FIRST_SHARPNESS, LAST_SHARPNESS = 1.0, 60.0


@dataclass(frozen=True)
class Loops:
    """Short cycles: `edges (L, 3)` rows of the edge list, −1 in the last column for a pair of parallel edges, and
    `deviation (L,)` in [0, 1): χ² / (χ² + threshold) of the product of their motions.
    """

    edges: Ints
    deviation: Floats


def short_loops(
    edges: Ints, i_from_j: Floats, rotation_variance: Floats, translation_variance: Floats, threshold: float
) -> Loops:
    """The triangles and parallel pairs of a graph, each with its deviation. Variances are for one axis, rad² and m²."""
    count = int(edges.max(initial=-1)) + 1
    simple = orient_edges(edges, count)
    order = np.argsort(simple.row, kind="stable")
    first = np.searchsorted(simple.row[order], np.arange(len(simple.edges) + 1))
    complex_ = flag_complex(edges, count)
    corners = complex_.simplices[2]
    sides = np.stack([complex_.rows_of(corners[:, pair]) for pair in ([0, 1], [1, 2], [0, 2])], axis=1)
    triples = _choices(sides, first, order)
    pairs = _parallel_pairs(first, order)
    forward = np.where((simple.sign > 0)[:, None, None], i_from_j, se3.inverse(i_from_j))
    triangle = forward[triples[:, 0]] @ forward[triples[:, 1]] @ se3.inverse(forward[triples[:, 2]])
    twice = forward[pairs[:, 0]] @ se3.inverse(forward[pairs[:, 1]])
    rows = np.concatenate([triples, np.column_stack([pairs, np.full(len(pairs), -1)])])
    around = np.concatenate([triangle, twice])
    reach = np.einsum("ei,ei->e", i_from_j[:, :3, 3], i_from_j[:, :3, 3])
    levered = translation_variance + reach * rotation_variance
    present = rows >= 0
    turn = np.where(present, rotation_variance[rows], 0.0).sum(axis=1)
    shift = np.where(present, levered[rows], 0.0).sum(axis=1)
    xi = se3.log(around)
    chi2 = np.einsum("li,li->l", xi[:, :3], xi[:, :3]) / turn + np.einsum("li,li->l", xi[:, 3:], xi[:, 3:]) / shift
    return Loops(rows, chi2 / (chi2 + threshold))


def _choices(sides: Ints, first: Ints, order: Ints) -> Ints:
    """Every choice (N, 3) of one measured edge for each side of each triangle."""
    parallel = np.diff(first)[sides]
    total = parallel.prod(axis=1)
    row = np.repeat(np.arange(len(sides)), total)
    number = np.arange(len(row)) - np.repeat(np.cumsum(total) - total, total)
    columns = []
    for side in range(3):
        width = parallel[row, side]
        columns.append(order[first[sides[row, side]] + number % width])
        number = number // width
    return np.stack(columns, axis=1)


def _parallel_pairs(first: Ints, order: Ints) -> Ints:
    """Each measured edge with the next parallel one, and the last with the first (N, 2)."""
    size = np.diff(first)
    row = np.repeat(np.arange(len(size)), np.where(size > 1, size, 0))
    number = np.arange(len(row)) - np.searchsorted(row, row)
    kept = (number + 1 < size[row]) | (size[row] > 2)
    row, number = row[kept], number[kept]
    return np.stack([order[first[row] + number], order[first[row] + (number + 1) % size[row]]], axis=1)


def edge_corruption(loops: Loops, edge_count: int) -> Floats:
    """How bad (E,) each edge is, from 0 to 1; NaN where no short cycle tests it."""
    present = loops.edges >= 0
    member = loops.edges[present]
    loop = np.nonzero(present)[0]
    tested = np.bincount(member, minlength=edge_count) > 0
    score = np.full(edge_count, 0.5)
    for sharpness in np.geomspace(FIRST_SHARPNESS, LAST_SHARPNESS, ROUNDS):
        others = np.where(present, score[loops.edges], 0.0).sum(axis=1)[loop] - score[member]
        weight = np.exp(-sharpness * others)
        total = np.bincount(member, weight, edge_count)
        score = np.bincount(member, weight * loops.deviation[loop], edge_count) / np.where(total > 0, total, 1.0)
    return np.where(tested, score, np.nan)
