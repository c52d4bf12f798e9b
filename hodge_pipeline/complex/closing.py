"""Closing errors of cycles, and whether they close better than by chance."""

from __future__ import annotations

import math

import numpy as np
from scipy.special import chndtr, gammaln

from hodge_pipeline import se3
from hodge_pipeline.complex.cycles import Loops, directed, loop_products
from hodge_pipeline.complex.short_cycles import short_cycles
from hodge_pipeline.types import Bools, Floats, Ints, ViewGraph

AT_MIDDLE = 4
"""Number of first frames of a cycle at whose centre its displacement is measured."""
LEVEL = 0.01
"""Expected number of choices of edges, among all, that close so well by chance: as the 1 % gate of edges."""
UNIFORM_RAD2 = (8 * math.pi**2) ** (2 / 3) / (2 * math.pi)
"""Variance of an axis at which a Gaussian is as dense at 0 as uniform rotations, which spread no wider."""
FLAT = 100.0
"""Ratio of the median squares of motions, to that of the largest axis, below which an axis holds noise alone."""
FAR = 1e6
"""Squared distance of an aim, in variances of a walk, beyond which the walk is no evidence."""
LEAST_VARIANCE = 1e-200
"""Least variance of a walk, of edges that do not move, to divide by."""
TRIANGLES_PER_EDGE = 8
"""Most triangles listed per edge: all but the first over an edge repeat its evidence."""


def cycle_errors(loops: Loops, i_from_j: Floats) -> tuple[Floats, Floats]:
    """The closing error of each cycle: angle (L,), radians, and displacement (L,) at the centre of its first frames,
    metres.
    """
    products, middle = loop_products(loops, i_from_j), _middles(loops, i_from_j)
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

    Cycles are taken shortest first. Each with a run of edges that no cycle before it holds is an independent test:
    under the null hypothesis that run is a walk of the same lengths in random directions, and the probability that it
    ends as near to where the rest of the cycle leads is uniform. So minus the sum of the logarithms is gamma
    distributed, although cycles share edges. A Bonferroni factor counts all choices of as many edges, since the solver
    chose the best. Limits: edges that all go the same way in their own frames are not random; and rotations, or
    translations, that are noise alone mask the others.
    """
    graph, every = graph.select(kept), graph.edge_count
    loops, run = _begun_at_new_edges(short_cycles(graph.edges, graph.vertex_count, TRIANGLES_PER_EDGE))
    if not len(loops):
        return False
    out, cycles = every - len(kept), len(loops)
    log_choices = gammaln(every + 1) - gammaln(out + 1) - gammaln(len(kept) + 1) + math.log(every)
    mean = -float(_log_chance(loops, run, graph.i_from_j).mean())
    # Chernoff's bound of the gamma distribution's tail
    return mean > 1 and cycles * (1 + math.log(mean) - mean) + log_choices < math.log(LEVEL)


def _begun_at_new_edges(loops: Loops) -> tuple[Loops, Ints]:
    """The cycles with an edge that no cycle before holds, shortest first, each begun at its first run of such edges;
    and the length (L,) of that run.
    """
    loops = loops.select(np.argsort(loops.lengths, kind="stable"))
    new = np.zeros(len(loops.edge), bool)
    new[np.unique(loops.edge, return_index=True)[1]] = True
    holds = np.zeros(len(loops), bool)
    holds[loops.rows[new]] = True
    new, loops = new[holds[loops.rows]], loops.select(np.flatnonzero(holds))
    first, rows, lengths = loops.offsets[:-1], loops.rows, loops.lengths
    place = np.arange(len(new)) - first[rows]

    def least(wanted: Bools, otherwise: Ints) -> Ints:
        """The first place (L,) in each cycle where `wanted (N,)` is."""
        return np.minimum(np.minimum.reduceat(np.where(wanted, place, len(new)), first), otherwise)

    begin = least(new & ~new[first[rows] + (place - 1) % lengths[rows]], lengths) % lengths
    entry = first[rows] + (place + begin[rows]) % lengths[rows]
    return Loops(loops.offsets, loops.edge[entry], loops.sign[entry]), least(~new[entry], lengths)


def _log_chance(loops: Loops, run: Ints, i_from_j: Floats) -> Floats:
    """The log-probability (L,) that the first `run (L,)` motions of each cycle, in random directions, end as near as
    they do to where the others lead.

    Rotations are judged as if the others did not turn, which makes no chance smaller (Anderson, 1955).
    """
    rows = loops.rows
    of_run = np.arange(len(rows)) - loops.offsets[:-1][rows] < run[rows]
    walk = Loops(np.concatenate([[0], np.cumsum(run)]), loops.edge[of_run], loops.sign[of_run])
    end, left = loop_products(walk, i_from_j), loop_products(loops, i_from_j)
    aim = se3.inverse(left) @ end
    turn, shift, aim_m = se3.so3_log(i_from_j[:, :3, :3]), i_from_j[:, :3, 3], aim[:, :3, 3]
    turns, shifts = _moving(turn, se3.so3_log(aim[:, :3, :3])), _moving(shift, aim_m)
    spread_rad2 = np.clip(walk.sums(_variance(turn[:, turns])), LEAST_VARIANCE, UNIFORM_RAD2)
    spread_m2 = np.maximum(walk.sums(_variance(shift[:, shifts])), LEAST_VARIANCE)
    square = (se3.so3_log(left[:, :3, :3])[:, turns] ** 2).sum(axis=1) / spread_rad2
    square += ((end[:, :3, 3] - aim_m)[:, shifts] ** 2).sum(axis=1) / spread_m2
    centre = np.where(run == 1, (aim_m[:, shifts] ** 2).sum(axis=1) / spread_m2, 0.0)
    chance = np.where(centre < FAR, chndtr(square, turns.sum() + shifts.sum(), np.minimum(centre, FAR)), 1.0)
    return np.asarray(np.log(np.clip(chance, np.finfo(float).tiny, 1)))


def _moving(of_edges: Floats, of_aims: Floats) -> Bools:
    """The axes (3,) along which edges (E, 3) or aims (L, 3) move by more than noise out of a plane."""
    usual = np.maximum(np.median(of_edges**2, axis=0), np.median(of_aims**2, axis=0))
    return np.asarray(usual > usual.max() / FLAT)


def _variance(motions: Floats) -> Floats:
    """The variance per axis (N,) of motions of the lengths of these (N, a) in random directions."""
    return np.asarray((motions**2).sum(axis=1) / max(motions.shape[1], 1))
