"""Which of the listed cycles close, which are evidence for or against each edge, and when they are none."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.complex.chi2 import MEDIAN_CHI2
from hodge_pipeline.complex.closing import cycle_errors
from hodge_pipeline.complex.cycles import Loops
from hodge_pipeline.diagnosis.noise import Noise
from hodge_pipeline.evaluation.residuals import edge_residuals
from hodge_pipeline.solvers.backbone.sequence import sequential_edges
from hodge_pipeline.solvers.backbone.step_tests import OF_STEPS
from hodge_pipeline.types import Bools, Floats, Ints, ViewGraph

CLOSES_BELOW = 30.0
"""χ² over six dimensions of a cycle that closes, and of two edges that agree. Generous, since tails are heavy."""
WITNESSES = 3
"""Most cycles for, and most against, that an edge names."""
SIGMAS = 4.0
"""Standard deviations by which more cycles must close well than by chance: 118 and more do in eight graphs of the
literature, 12 and 24 in two lattices with wrong edges; where all loops are random up to 3.5, but 64 in one of the eight
with parallel edges.
"""


@dataclass(frozen=True)
class Cycles:
    """The listed cycles: edges, closing errors `angle_rad`, `displacement_m (L,)`, `chi2 (L,)` by the noise of the
    edges, and which of them are within the gate, `closes (L,)`.
    """

    loops: Loops
    angle_rad: Floats
    displacement_m: Floats
    chi2: Floats
    closes: Bools


def judge_cycles(loops: Loops, angle: Floats, displacement_m: Floats, noise: Noise, reach_m: float) -> Cycles:
    """The cycles with their χ²: variances of edges add up, and rotations also move what follows, by `reach_m`."""
    turn, shift = loops.sums(noise.rotation_rad**2), loops.sums(noise.translation_m**2)
    swing = turn * (reach_m * loops.lengths) ** 2 / 12
    chi2 = angle**2 / np.maximum(turn, 1e-300) + displacement_m**2 / np.maximum(shift + swing, 1e-300)
    return Cycles(loops, angle, displacement_m, chi2, chi2 < CLOSES_BELOW)


def close_by_chance(cycles: Cycles, i_from_j: Floats, noise: Noise, reach_m: float) -> bool:
    """Whether cycles close to below the median χ² hardly more often than with motions (E, 4, 4) permuted among the
    edges.

    Then most edges are wrong, or stated errors as large as the motions, and closing cycles are no evidence.
    """
    dealt = i_from_j[np.random.default_rng(0).permutation(len(i_from_j))]
    others = judge_cycles(cycles.loops, *cycle_errors(cycles.loops, dealt), noise, reach_m)
    well, chance = (int((each.chi2 < MEDIAN_CHI2[6]).sum()) for each in (cycles, others))
    return bool(well <= chance + SIGMAS * np.sqrt(chance * (1 - chance / max(len(cycles.chi2), 1))))


def is_folded(graph: ViewGraph, kept: Bools, world_from_cam: Floats) -> bool:
    """Whether consecutive edges among those `kept (E,)` are off by a large part of both their displacement and their
    angle, on half of the path: loops that join any two places have then folded the sequence upon itself.

    Of the path, not of the steps: where the sequence stands still, errors are all of a step.
    """
    steps = graph.select(np.flatnonzero(sequential_edges(graph) & kept))
    off = np.stack(edge_residuals(steps, world_from_cam))
    moved = np.stack([np.linalg.norm(steps.i_from_j[:, :3, 3], axis=1), se3.rotation_angle(steps.i_from_j)])
    on_path = (moved * (off >= moved / OF_STEPS)).sum(axis=1)
    return bool(moved.any() and (on_path >= moved.sum(axis=1) / 2).all())


def usual_share(cycles: Cycles) -> float:
    """The share of right edges, estimated from the share of closing cycles; 1 where there is no cycle.

    A cycle closes where all its edges are right: p to the power of its length.
    """
    if not len(cycles.loops):
        return 1.0
    closing = float(cycles.closes.mean())
    return float(max(closing, 1 / (len(cycles.loops) + 1)) ** (1 / float(cycles.loops.lengths.mean())))


def closing_support(cycles: Cycles, prior: Floats) -> Floats:
    """How many cycles (E,) close over each edge, each weighted by the prior of its other edges."""
    strength = np.maximum(0.0, 1 - cycles.chi2 / CLOSES_BELOW)
    return cycles.loops.sums_at_edges(strength * np.exp(cycles.loops.sums(np.log(prior))), len(prior)) / prior


def witnesses(cycles: Cycles, probability: Floats, closing: bool) -> Ints:
    """For each edge (E, 3) the closing, or failing, cycles whose other edges are the likeliest; −1 for none."""
    wanted = np.flatnonzero(cycles.closes == closing)
    loops = cycles.loops.select(wanted)
    row, edge = loops.rows, loops.edge
    logs = np.log(np.clip(np.nan_to_num(probability, nan=0.5), 1e-3, 1.0))
    others = loops.sums(logs)[row] - logs[edge]
    order = np.lexsort((row, -others, edge))
    ranked = edge[order]
    rank = np.arange(len(order)) - np.searchsorted(ranked, ranked)
    out = np.full((len(probability), WITNESSES), -1, np.int64)
    top = rank < WITNESSES
    out[ranked[top], rank[top]] = wanted[row[order[top]]]
    return out
