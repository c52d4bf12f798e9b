"""How exact right edges are, found from the cycles that close."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hodge_pipeline.complex.cycles import Loops
from hodge_pipeline.solvers.weights import edge_weights
from hodge_pipeline.types import Floats, ViewGraph

MAXWELL_MEDIAN = 1.538
DEFAULT_ANGLE_RAD = 0.03
DEFAULT_SHARE = 0.05
"""Of an edge's usual length: its error where no cycle tells."""
FIRST_GATE_RAD = 0.35
FIRST_GATE_SHARE = 0.6
LONGEST_CYCLE = 4
FEWEST_CYCLES = 20
HEAVY_TAILS = 1.9
"""Errors of registration have heavier tails than a Gaussian of the same median."""

LEVER = 1.8
"""Of the reach: how far around the working point lies what is seen, which an error of rotation moves along."""


@dataclass(frozen=True)
class Noise:
    """Standard deviations to an axis (E,) of each edge, radians and metres at the working point."""

    rotation_rad: Floats
    translation_m: Floats


def edge_noise(graph: ViewGraph, loops: Loops, angle: Floats, moved: Floats, prior: Floats, reach_m: float) -> Noise:
    """The noise of each edge: the graph's information gives the proportions, cycles that close give the scale."""
    rotation, translation, informed = _proportions(graph)
    sizes = []
    for relative, error, gate, fallback in (
        (rotation, angle, FIRST_GATE_RAD, DEFAULT_ANGLE_RAD),
        (translation, moved, FIRST_GATE_SHARE * reach_m, DEFAULT_SHARE * reach_m),
    ):
        sizes.append(_scale(loops, relative, error, gate, prior, 1.0 if informed else fallback))
    if not informed:
        sizes[1] = max(sizes[1], LEVER * sizes[0] * reach_m)
    return Noise(sizes[0] * rotation, sizes[1] * translation)


def _proportions(graph: ViewGraph) -> tuple[Floats, Floats, bool]:
    """Standard deviations from the information, or ones where it says the same of every edge (the identity)."""
    same = graph.edge_count < 2 or bool((graph.information == graph.information[:1]).all())
    if same and (not graph.edge_count or np.array_equal(graph.information[0], np.eye(6))):
        return np.ones(graph.edge_count), np.ones(graph.edge_count), False
    flat = graph.dimension == 2
    weights = edge_weights(graph, 2 if flat else 3)
    return _deviation(weights.kappa if flat else 2 * weights.kappa), _deviation(weights.tau), True


def _deviation(precision: Floats) -> Floats:
    known = precision > 0
    usual = float(np.median(precision[known])) if known.any() else 1.0
    return np.asarray(1 / np.sqrt(np.clip(np.where(known, precision, usual), usual / 10, usual * 10)))


def _scale(loops: Loops, relative: Floats, error: Floats, gate: float, prior: Floats, fallback: float) -> float:
    """The scale at which half of the short cycles that close have an error below the median of its distribution."""
    short = np.flatnonzero((loops.lengths <= LONGEST_CYCLE) & (error < gate))
    if len(short) < FEWEST_CYCLES:
        return fallback
    chosen = loops.select(short)
    row = np.repeat(np.arange(len(short)), chosen.lengths)
    spread = np.sqrt(np.bincount(row, relative[chosen.edge] ** 2, len(short)))
    weight = np.exp(np.bincount(row, np.log(prior[chosen.edge]), len(short)))
    ratio = error[short] / spread
    order = np.argsort(ratio)
    total = np.cumsum(weight[order])
    median = float(ratio[order][np.searchsorted(total, total[-1] / 2)])
    return max(HEAVY_TAILS * median / MAXWELL_MEDIAN, 1e-3 * fallback)
