"""How well cycles close: what the motions along each leave over, and whether chance would let them close so well."""

from __future__ import annotations

import math

import numpy as np
from scipy.special import gammainc, gammaln

from hodge_pipeline import se3
from hodge_pipeline.complex.cycles import Loops, directed, loop_products
from hodge_pipeline.complex.short_cycles import loops_of_chords
from hodge_pipeline.types import Floats, Ints, ViewGraph

AT_MIDDLE = 4
"""Frames of a cycle, the first ones, whose middle is where its displacement is measured."""
LEVEL = 0.01
"""Choices of edges that agree so well by chance, expected among all: as the gate of the edges, which 1 % miss."""
UNIFORM_RAD2 = (8 * math.pi**2) ** (2 / 3) / (2 * math.pi)
"""Variance of an axis at which a Gaussian is as dense at 0 as uniform rotations, which spread no wider."""
FLAT = 100.0
"""Times as large as usual along the axis that moves most are squares of motions along one that holds noise alone."""


def cycle_errors(loops: Loops, i_from_j: Floats, products: Floats | None = None) -> tuple[Floats, Floats]:
    """The angle (L,) in radians and the displacement (L,) in metres that the product of motions along each cycle
    leaves, the latter at the middle of the cycle's frames; `products (L, 4, 4)` where they are known.
    """
    products = loop_products(loops, i_from_j) if products is None else products
    middle = _middles(loops, i_from_j)
    displacement_m = np.einsum("lij,lj->li", products[:, :3, :3], middle) + products[:, :3, 3] - middle
    return np.linalg.norm(se3.so3_log(products[:, :3, :3]), axis=1), np.linalg.norm(displacement_m, axis=1)


def _middles(loops: Loops, i_from_j: Floats) -> Floats:
    """The mean (L, 3) of the positions of the first few frames of each cycle, seen from its first."""
    total, here = np.zeros((len(loops), 3)), np.broadcast_to(np.eye(4), (len(loops), 4, 4)).copy()
    for step in range(AT_MIDDLE):
        rows = np.flatnonzero(loops.lengths > step)
        entry = loops.offsets[rows] + step
        total[rows] += here[rows, :3, 3]
        here[rows] = here[rows] @ directed(i_from_j, loops.edge[entry], loops.sign[entry])
    return np.asarray(total / np.clip(loops.lengths, 1, AT_MIDDLE)[:, None])


def closes_better_than_chance(graph: ViewGraph, kept: Ints) -> bool:
    """Whether the cycles of the kept edges (rows) close so well that no choice of random edges is expected to.

    Around a cycle of edges in random directions the motion is a walk of their lengths, and the probability of a nearer
    end is uniform; of C cycles, minus the sum of the logarithms is gamma distributed. Every choice of as many
    of the edges counts, whichever the solver made: so that it chose the best makes nothing look better than it is.
    """
    graph, every = graph.select(kept), graph.edge_count
    loops = loops_of_chords(graph.edges, graph.vertex_count)
    if not len(loops):
        return False
    left, squares = se3.log(loop_products(loops, graph.i_from_j)), se3.log(graph.i_from_j) ** 2
    usual = np.median(squares, axis=0)
    most = np.repeat(usual.reshape(2, 3).max(axis=1), 3)
    limit = np.repeat([UNIFORM_RAD2, np.inf], 3)
    moving = usual > 0, usual > most / FLAT  # out of a plane there may be noise alone, which says nothing
    out, cycles = every - len(kept), len(loops)
    log_choices = gammaln(every + 1) - gammaln(out + 1) - gammaln(len(kept) + 1) + math.log(len(moving) * every)
    mean = max(
        -float(_log_chance(loops, left[:, axes], squares[:, axes], limit[axes]).sum()) / cycles for axes in moving
    )
    # Chernoff's bound of the gamma distribution's tail
    return mean > 1 and cycles * (1 + math.log(mean) - mean) + log_choices < math.log(LEVEL)


def _log_chance(loops: Loops, left: Floats, squares: Floats, most: Floats) -> Floats:
    """The logarithm of how likely (L,) a cycle of edges in random directions leaves less than `left (L, a)` along some
    axes; `squares (E, a)` of the edges' own motions, and the largest variances `most (a,)`.
    """
    if not left.shape[1]:
        return np.zeros(len(left))
    spread = np.add.reduceat(squares[loops.edge], loops.offsets[:-1], axis=0)
    spread = np.clip(spread, np.finfo(float).tiny, most)
    chance = gammainc(left.shape[1] / 2, (left**2 / spread).sum(axis=1) / 2)
    return np.asarray(np.log(np.maximum(chance, np.finfo(float).tiny)))
