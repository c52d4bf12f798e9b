"""Edges that share the blame for a loop: one of them is wrong, and no cycle of the graph decides which."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hodge_pipeline.complex.series import series_classes
from hodge_pipeline.diagnosis.evidence import Evidence
from hodge_pipeline.diagnosis.result import Cycles
from hodge_pipeline.diagnosis.robust_poses import Fit
from hodge_pipeline.types import Bools, Floats, Ints


@dataclass(frozen=True)
class SharedBlame:
    """Where an alignment had to leave out one of several edges that no cycle tells apart.

    - `unvouched (E,)`: edges in use because another one was left out, and either may be the wrong one: those that the
      same cycles pass as that one, and the only connections between two parts, over which no cycle closes.
    - `cycle (E,)`: the shortest failing cycle of each such edge, and of each that was left out for it; −1 elsewhere.
    - `probability (E,)`: of being right, of an edge left out that shares the blame: by its prior among those it shares
      it with, of which one is wrong; 0 elsewhere.
    - `undecided (E,)`: the failing cycle that is the only test of all its edges, −1 elsewhere.
    """

    unvouched: Bools
    cycle: Ints
    probability: Floats
    undecided: Ints


def share_blame(cycles: Cycles, fit: Fit, evidence: Evidence) -> SharedBlame:
    """Who shares the blame, in this alignment."""
    loops, count = cycles.loops, len(evidence.graph.edges)
    row, edge = loops.rows, loops.edge
    untold = np.bincount(edge, cycles.closes[row], count) == 0
    untold &= ~evidence.in_no_listed_cycle
    classes = series_classes(evidence.graph.edges, evidence.graph.vertex_count)
    doubted = _in_series_with(~fit.used, classes)
    unvouched = fit.used & ((np.isinf(fit.resistance) & untold) | doubted)
    holds = np.bincount(row, unvouched[edge], len(loops)) > 0
    # an edge that was left out shares the blame where each of its cycles has an edge that no closing cycle confirms
    left_out = ~fit.used & ((untold & (np.bincount(edge, ~holds[row], count) == 0)) | doubted)
    concerned = unvouched | left_out
    cycle = _shortest(loops.lengths, row, edge, concerned)
    odds = (1 - evidence.prior) / evidence.prior
    among = np.bincount(row, np.where(concerned[edge], odds[edge], 0.0), len(loops))
    probability = np.zeros(count)
    named = left_out & (cycle >= 0)  # of a large graph the longest cycles are not listed
    probability[named] = 1 - odds[named] / among[cycle[named]]
    return SharedBlame(unvouched, cycle, probability, _undecided(cycles, classes))


def _undecided(cycles: Cycles, classes: Ints) -> Ints:
    """For each edge (E,) the row of the failing cycle that is the only test of all its edges, which are in series: one
    of them is wrong, and no other cycle decides which. −1 where there is none.
    """
    out = np.full(len(classes), -1, np.int64)
    failing = np.flatnonzero(~cycles.closes)
    loops = cycles.loops.select(failing)
    row = loops.rows
    alone = classes[loops.edge] == classes[loops.edge[loops.offsets[row]]]
    alone = np.bincount(row, alone, len(loops)) == loops.lengths
    out[loops.edge[alone[row]]] = failing[row[alone[row]]]
    return out


def _in_series_with(chosen: Bools, classes: Ints) -> Bools:
    """Edges (E,) that the same cycles pass as another one, where one of these is chosen (E,)."""
    in_class = classes >= 0
    count = int(classes.max(initial=-1)) + 1
    several = np.bincount(classes[in_class], minlength=count) > 1
    struck = np.bincount(classes[in_class], chosen[in_class], count) > 0
    out = np.zeros(len(classes), bool)
    out[in_class] = (several & struck)[classes[in_class]]
    return out


def _shortest(lengths: Ints, row: Ints, edge: Ints, concerned: Bools) -> Ints:
    """The shortest cycle (E,) through each edge that is concerned, −1 for the others."""
    out = np.full(len(concerned), -1, np.int64)
    order = np.argsort(-lengths[row], kind="stable")
    out[edge[order]] = row[order]  # of an edge in several the last, shortest, stays
    return np.where(concerned, out, -1)
