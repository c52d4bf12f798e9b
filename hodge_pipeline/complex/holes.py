"""The loops of a viewing graph that no triangles fill: generators of the first homology of its flag complex."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hodge_pipeline.complex.cech import clique_counts, flag_complex, orient_edges
from hodge_pipeline.complex.cycles import Loops, SpanningForest, fundamental_loops, spanning_forest
from hodge_pipeline.errors import GraphError
from hodge_pipeline.types import Ints

MOST_TRIANGLES = 100_000
"""A limit on time: a ring of 9000 vertices with 54,000 triangles takes 31 s."""
CHORDS_AT_A_TIME = 4096
"""Whose loops are held in memory: those of a large graph are long."""


@dataclass(frozen=True)
class Holes:
    """How many there are, and the loops around the largest of them, the shortest first."""

    count: int
    loops: Loops


def unfilled_loops(edges: Ints, vertex_count: int, most_loops: int | None = None) -> Holes:
    """One loop for each hole, over the rows of `edges` (E, 2); parallel edges leave no hole. `most_loops`: how many
    loops to give, the longest.

    The loops that chords close in a breadth-first forest span all cycles. Each triangle is a relation between chords
    over GF(2); eliminating the chord of the longest loop from each leaves as many chords as there are holes, b1.
    Raises `GraphError` above `MOST_TRIANGLES`.
    """
    oriented = orient_edges(edges, vertex_count)
    if clique_counts(oriented.edges, vertex_count)[2] > MOST_TRIANGLES:
        raise GraphError(f"holes are sought in graphs of at most {MOST_TRIANGLES} triangles")
    forest = spanning_forest(oriented.edges, vertex_count)
    rank = np.full(len(oriented.edges), -1, np.int64)
    by_length = np.argsort(_lengths(forest), kind="stable")
    rank[forest.chords[by_length]] = np.arange(len(by_length))
    complex_ = flag_complex(oriented.edges, vertex_count)
    corners = complex_.simplices[2]
    sides = np.stack([complex_.rows_of(corners[:, pair]) for pair in ([0, 1], [1, 2], [0, 2])], axis=1)
    open_ranks = sorted(set(range(len(by_length))) - _filled(rank[sides]))
    first = 0 if most_loops is None else max(0, len(open_ranks) - most_loops)
    chords = forest.chords[by_length[np.array(open_ranks[first:], np.int64)]]
    loops = fundamental_loops(forest, chords)
    measured = oriented.first[loops.edge]
    return Holes(len(open_ranks), Loops(loops.offsets, measured, loops.sign * oriented.sign[measured]))


def _lengths(forest: SpanningForest) -> Ints:
    """How many edges the loop of each chord has."""
    parts = [
        fundamental_loops(forest, forest.chords[begin : begin + CHORDS_AT_A_TIME]).lengths
        for begin in range(0, len(forest.chords), CHORDS_AT_A_TIME)
    ]
    return np.concatenate([np.zeros(0, np.int64), *parts])


def _filled(triangles: Ints) -> set[int]:
    """The ranks of the chords that triangles (T, 3) eliminate; −1 is an edge of the forest."""
    reduced: dict[int, set[int]] = {}
    for triangle in triangles.tolist():
        left = {rank for rank in triangle if rank >= 0}
        while left and (pivot := max(left)) in reduced:
            left ^= reduced[pivot]
        if left:
            reduced[max(left)] = left
    return set(reduced)
