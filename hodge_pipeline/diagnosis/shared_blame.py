"""Edges that share the blame for a loop: one of them is wrong, and no cycle of the graph decides which."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hodge_pipeline.complex.series import series_classes
from hodge_pipeline.diagnosis.cycles import Cycles
from hodge_pipeline.diagnosis.evidence import Evidence
from hodge_pipeline.diagnosis.robust_poses import Solved
from hodge_pipeline.types import Bools, Floats, Ints


@dataclass(frozen=True)
class SharedBlame:
    """Where an alignment had to leave out one of several edges that no cycle distinguishes.

    - `untestable (E,)`: used edges that may be wrong in place of one left out, which are those in series with it and
      bridges over which no cycle closes; and edges whose only test is one failing cycle, but for one left out that is
      likelier wrong than all the others together.
    - `cycle (E,)`: the shortest failing cycle of each untestable edge, and of each edge left out in place of one; −1
      elsewhere.
    - `probability (E,)`: that an edge left out in place of another is right, by the prior odds of the edges of its
      cycle, of which one is wrong; 0 elsewhere.
    """

    untestable: Bools
    cycle: Ints
    probability: Floats


def share_blame(cycles: Cycles, fit: Solved, evidence: Evidence) -> SharedBlame:
    """The edges that share the blame in a solution."""
    loops, count = cycles.loops, len(evidence.graph.edges)
    never_closes = (loops.sums_at_edges(cycles.closes, count) == 0) & ~evidence.in_no_listed_cycle
    classes = series_classes(evidence.graph.edges, evidence.graph.vertex_count)
    doubted = _in_series_with(~fit.used, classes)
    unconfirmed = fit.used & ((np.isinf(fit.resistance) & never_closes) | doubted)
    # an edge that was left out shares the blame where each of its cycles has an unconfirmed edge
    all_confirmed = loops.sums(unconfirmed) == 0
    left_out = ~fit.used & ((never_closes & (loops.sums_at_edges(all_confirmed, count) == 0)) | doubted)
    # of edges in series all of which one cycle passes, no other cycle passes any
    of_one_class = classes[loops.edge] == classes[loops.edge[loops.offsets[loops.rows]]]
    alone = np.bincount(loops.rows, of_one_class, len(loops)) == loops.lengths
    undecided = loops.sums_at_edges(alone & ~cycles.closes, count) > 0
    cycle = np.full(count, -1, np.int64)
    longest_first = np.argsort(-loops.lengths[loops.rows], kind="stable")
    cycle[loops.edge[longest_first]] = loops.rows[longest_first]  # of an edge in several the last, shortest, stays
    cycle[~(unconfirmed | left_out | undecided)] = -1
    odds = (1 - evidence.prior) / evidence.prior
    among = loops.sums(np.where(unconfirmed | left_out, odds, 0.0))
    probability = np.zeros(count)
    named = left_out & (cycle >= 0)  # of a large graph the longest cycles are not listed
    probability[named] = 1 - odds[named] / among[cycle[named]]
    undecided &= ~named | (probability >= 0.5)  # what is likelier wrong than all the others is no tie
    return SharedBlame(unconfirmed | undecided, cycle, probability)


def _in_series_with(chosen: Bools, classes: Ints) -> Bools:
    """Edges (E,) of series classes of two or more of which one is chosen (E,)."""
    names = np.where(classes >= 0, classes, len(classes) + np.arange(len(classes)))  # a bridge is in series with none
    place, size = np.unique(names, return_inverse=True, return_counts=True)[1:]
    place = place.reshape(-1)
    return np.asarray(((size > 1) & (np.bincount(place, chosen, len(size)) > 0))[place])
