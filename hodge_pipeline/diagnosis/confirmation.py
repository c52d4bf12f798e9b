"""Whether the cycles of the edges that a robust solve keeps close better than by chance."""

from __future__ import annotations

import math

import numpy as np
from scipy.special import gammainc, gammaln

from hodge_pipeline import se3
from hodge_pipeline.complex.cycles import SpanningForest, fundamental_products, spanning_forest
from hodge_pipeline.types import Floats, Ints, ViewGraph

LEVEL = 0.01
"""Choices of edges that agree so well by chance, expected among all: as the gate of the edges, which 1 % miss."""
MEDIAN_CHI2_ONE = 0.4549
"""Of χ² with one degree of freedom."""
UNIFORM_RAD2 = (8 * math.pi**2) ** (2 / 3) / (2 * math.pi)
"""Variance of an axis at which a Gaussian is as dense at 0 as uniform rotations, which spread no wider."""


def confirmed(graph: ViewGraph, kept: Ints) -> bool:
    """Whether the cycles of the kept edges (rows) close so well that no choice of random edges is expected to.

    Around a cycle of random edges the motion is a walk of steps as large as the measured ones, and the probability of
    a nearer end is uniform; of C cycles, minus the sum of the logarithms is gamma distributed. Every choice of as many
    of the edges counts, whichever the solver made: so that it chose the best makes nothing look better than it is.
    """
    forest = spanning_forest(graph.edges[kept], graph.vertex_count)
    chords = forest.chords[forest.edges[forest.chords, 0] != forest.edges[forest.chords, 1]]
    if not len(chords):
        return False
    left = se3.log(fundamental_products(forest, graph.i_from_j[kept], chords))
    log_chance = _log_chance(graph, left, cycle_lengths(forest, chords))
    every, out, cycles = graph.edge_count, graph.edge_count - len(kept), len(chords)
    log_choices = gammaln(every + 1) - gammaln(out + 1) - gammaln(len(kept) + 1) + math.log(every)
    mean = -float(log_chance.sum()) / cycles
    # Chernoff's bound of the gamma distribution's tail
    return mean > 1 and cycles * (1 + math.log(mean) - mean) + log_choices < math.log(LEVEL)


def _log_chance(graph: ViewGraph, left: Floats, lengths: Ints) -> Floats:
    """The logarithm of how likely (C,) a random cycle as long leaves less; axes without motion do not count.

    The median of the measured motions gives a step's spread on each axis, in spite of a few long ones.
    """
    step = np.median(se3.log(graph.i_from_j) ** 2, axis=0) / MEDIAN_CHI2_ONE
    axes = step > 0
    if not axes.any():
        return np.zeros(len(left))
    spread = np.outer(lengths, step)
    spread[:, :3] = np.minimum(spread[:, :3], UNIFORM_RAD2)
    chance = gammainc(axes.sum() / 2, (left[:, axes] ** 2 / spread[:, axes]).sum(axis=1) / 2)
    return np.asarray(np.log(np.maximum(chance, np.finfo(float).tiny)))


def cycle_lengths(forest: SpanningForest, chords: Ints) -> Ints:
    """The number of edges (C,) of each chord's cycle, by jumps of doubled length to where its two tree paths meet."""
    jumps = [np.where(forest.parent < 0, np.arange(len(forest.parent)), forest.parent)]
    while (jumps[-1] != jumps[-1][jumps[-1]]).any():
        jumps.append(jumps[-1][jumps[-1]])
    ends = forest.edges[chords]
    deep = np.take_along_axis(ends, forest.depth[ends].argmax(axis=1)[:, None], axis=1)[:, 0]
    other = ends.sum(axis=1) - deep
    ahead = forest.depth[deep] - forest.depth[other]
    for power, jump in enumerate(jumps):
        deep = np.where(ahead >> power & 1, jump[deep], deep)
    for jump in reversed(jumps):
        apart = jump[deep] != jump[other]
        deep, other = np.where(apart, jump[deep], deep), np.where(apart, jump[other], other)
    meeting = np.where(deep == other, deep, jumps[0][deep])
    return np.asarray(forest.depth[ends].sum(axis=1) - 2 * forest.depth[meeting] + 1)
