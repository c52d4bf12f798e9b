"""Which cycles close, which edges they can test, and which of them are evidence for or against each edge."""

from __future__ import annotations

import numpy as np

from hodge_pipeline.complex.cycles import Loops
from hodge_pipeline.diagnosis.noise import Noise
from hodge_pipeline.diagnosis.result import WITNESSES, Cycles
from hodge_pipeline.types import Floats, Ints

GATE = 30.0


def judge_cycles(loops: Loops, angle: Floats, displacement_m: Floats, noise: Noise, reach_m: float) -> Cycles:
    """The cycles with their χ²: variances add along a cycle, and angles swing what follows them."""
    row = _rows(loops)
    turn = np.bincount(row, noise.rotation_rad[loops.edge] ** 2, len(loops))
    shift = np.bincount(row, noise.translation_m[loops.edge] ** 2, len(loops))
    swing = turn * (reach_m * loops.lengths) ** 2 / 12
    chi2 = angle**2 / np.maximum(turn, 1e-300) + displacement_m**2 / np.maximum(shift + swing, 1e-300)
    return Cycles(loops, angle, displacement_m, chi2, chi2 < GATE)


def usual_share(cycles: Cycles) -> float:
    """The share of right edges, estimated from the share of closing cycles; 1 where there is no cycle.

    A cycle closes where all its edges are right: p to the power of its length.
    """
    if not len(cycles.loops):
        return 1.0
    closing = float(cycles.closes.mean())
    return float(max(closing, 1 / (len(cycles.loops) + 1)) ** (1 / float(cycles.loops.lengths.mean())))


def closing_support(cycles: Cycles, prior: Floats) -> Floats:
    """How many cycles (E,) close over each edge, each weighed by how likely its other edges are."""
    row, edge = _rows(cycles.loops), cycles.loops.edge
    total = np.bincount(row, np.log(prior[edge]), len(cycles.loops))
    others = np.exp(total[row] - np.log(prior[edge]))
    strength = np.maximum(0.0, 1 - cycles.chi2 / GATE)[row]
    return np.bincount(edge, strength * others, len(prior)).astype(float)


def witnesses(cycles: Cycles, probability: Floats, closing: bool) -> Ints:
    """For each edge (E, 3) the closing, or failing, cycles whose other edges are the likeliest; −1 for none."""
    wanted = np.flatnonzero(cycles.closes == closing)
    loops = cycles.loops.select(wanted)
    row, edge = _rows(loops), loops.edge
    logs = np.log(np.clip(np.nan_to_num(probability, nan=0.5), 1e-3, 1.0))
    others = np.bincount(row, logs[edge], len(loops))[row] - logs[edge]
    order = np.lexsort((row, -others, edge))
    ranked = edge[order]
    rank = np.arange(len(order)) - np.searchsorted(ranked, ranked)
    out = np.full((len(probability), WITNESSES), -1, np.int64)
    top = rank < WITNESSES
    out[ranked[top], rank[top]] = wanted[row[order[top]]]
    return out


def _rows(loops: Loops) -> Ints:
    return np.repeat(np.arange(len(loops)), loops.lengths)
