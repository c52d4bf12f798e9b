"""What the edges show before any alignment: the noise of those in cycles that close, and how likely each is right."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import expit

from hodge_pipeline.complex.cech import orient_edges
from hodge_pipeline.complex.closing import cycle_errors
from hodge_pipeline.complex.short_cycles import short_cycles
from hodge_pipeline.diagnosis.cycles import Cycles, closing_support, judge_cycles, usual_share
from hodge_pipeline.diagnosis.noise import Noise, edge_noise, recentred
from hodge_pipeline.diagnosis.options import DiagnosisOptions
from hodge_pipeline.types import Bools, Floats, Ints, ViewGraph

FLOOR, CEILING = 0.05, 0.98
"""Bounds of the prior probability by the order of views, so that cycles can overrule it."""
FAR_SHARE = 0.25
"""Pairs further apart than this share of the vertices give the rate at which any two views are joined."""
LEAST_ODDS = 2.0
"""Least odds ratio of neighbours against far pairs to be joined, or against all to be right, for the order to count."""
DOUBTED = 2
"""Unjoined neighbours that are added to those counted: of few views all may be joined by chance."""
ROUNDS = 30
"""Of fixed-point iterations: a limit on cost. With 15 the shares of right edges by gap have not settled."""
FEW = 20
"""Edges of a gap at which the usual share of right edges weighs as much as their own. With 10 the cubicle has one right
edge more that is not kept.
"""
TRIED_FROM = 0.1
"""Share of far pairs that are joined, from which on all pairs are taken to have been tried."""
CYCLES_PER_EDGE = 64
"""Triangles kept to an edge, so that memory is bounded."""
LEAST_DEGREE = 4
"""Least mean degree of a view where all pairs were tried."""
FARTHEST = 2.0
"""Largest distance of a working point in median translations: one farther off is the centre of a turn."""
LEAST_GAIN = 0.3
"""Share of the median translation that a point must save."""
TIE_BREAK = 1e-3
"""Random share added to a weight: with equal ones a chain would be merged one edge a round."""


def order_prior(edges: Ints, vertex_count: int) -> Floats:
    """The probability (E,) that an edge is right, from its gap |i − j|.

    A wrong edge joins any two views; a right one joins views that overlap, in a sequence mostly neighbours, and takes
    the place of a wrong one. With f the share of all far pairs that are joined, a share r of near pairs holds q right
    edges and (1 - q) f wrong ones, so q = (r - f) / (1 - f), and an edge between them is right with probability q / r.
    All are equal where neighbours are hardly more often joined than far pairs. Vertex rows are the order.
    """
    place, bounds = _gap_classes(edges, vertex_count)
    simple = orient_edges(edges, vertex_count).edges
    joined = np.bincount(_gap_classes(simple, vertex_count)[0], minlength=len(bounds) - 1)[: len(bounds) - 1]
    pairs = np.array([_pairs(low, high, vertex_count) for low, high in zip(bounds[:-1], bounds[1:], strict=True)])
    rate = np.minimum(joined / np.maximum(pairs, 1), 1.0)
    far = _far_rate(simple, vertex_count)
    # by odds, which work where most pairs are joined too, with a few more missing neighbours: it may be chance
    missed = 1 - rate[0] + DOUBTED / max(pairs[0], 1)
    if rate[0] * (1 - far) < LEAST_ODDS * far * missed or not joined.any():
        return np.full(len(edges), 0.5)
    right = np.maximum(rate - far, 0) / (1 - far)
    share = np.clip(right / np.maximum(rate, 1e-12), FLOOR, CEILING)
    return np.asarray(share[place])


def right_by_gap(edges: Ints, vertex_count: int, cycles: Cycles, usual: float) -> Floats:
    """The probability (E,) that an edge is right, from the cycles that close over edges of its gap |i − j|.

    For graphs in which the rate of joined pairs is uninformative: all pairs are joined, or registration has left out
    bad edges already.
    `usual` holds where no cycle passes. No share exceeds what the number of edges of a gap can support: of n
    edges none of which fails the next one is right with (n + 1) / (n + 2) (Laplace's rule of succession).
    """
    place, bounds = _gap_classes(edges, vertex_count)
    loops = cycles.loops.select(np.flatnonzero(~cycles.closes))
    row, entry = loops.rows, place[loops.edge]
    passes = np.bincount(place[cycles.loops.edge], minlength=len(bounds))
    number = np.bincount(place, minlength=len(bounds))
    share = np.full(len(bounds), min(usual, CEILING))
    for _ in range(ROUNDS):
        # EM: in a failing cycle at least one edge is wrong; wrong edges are counted by gap
        close = np.exp(np.bincount(row, np.log(share)[entry], len(loops)))
        wrong = np.bincount(entry, ((1 - share)[entry] / (1 - close[row])), len(bounds))
        share = np.clip(1 - (wrong + 1 - usual) / (passes + 1), FLOOR, (number + 1) / (number + 2))
    # the estimate of a gap with few edges is poor: a doubtful edge would count against itself
    trust = number / (number + FEW)
    usual = float(np.clip(usual, FLOOR, CEILING))
    logit = trust * np.log(share / (1 - share)) + (1 - trust) * np.log(usual / (1 - usual))
    return np.asarray(expit(logit[place]))


def _if_neighbours_stand_out(edges: Ints, prior: Floats) -> Floats:
    """The prior (E,), or one half for all where neighbours are hardly more often right."""
    near = np.abs(edges[:, 1] - edges[:, 0]) == 1
    share, usual = float(prior[near].mean()) if near.any() else 0.0, float(prior.mean())
    stand_out = share / (1 - share) >= LEAST_ODDS * usual / (1 - usual)
    return prior if stand_out else np.full(len(edges), 0.5)


def every_pair_tried(edges: Ints, vertex_count: int) -> bool:
    """Whether far pairs are joined so often that registration seems to have been tried on all pairs."""
    simple = orient_edges(edges, vertex_count).edges
    if len(simple) < LEAST_DEGREE / 2 * vertex_count:
        return False  # of few views the ends of any loop are a large share of the far pairs
    return _far_rate(simple, vertex_count) >= TRIED_FROM


def _far_rate(simple: Ints, vertex_count: int) -> float:
    """The share of all far pairs that are among the joined ones (N, 2), each once and the lower first."""
    start = max(int(np.ceil(FAR_SHARE * vertex_count)), 2)
    far = simple[:, 1] - simple[:, 0] >= start
    return float(far.sum() / max(_pairs(start, vertex_count, vertex_count), 1))


def _gap_classes(edges: Ints, vertex_count: int) -> tuple[Ints, list[int]]:
    """The class (E,) of each edge by its gap |i − j|, and the least gap of each class."""
    bounds = [1, 2, 3, 5]
    while bounds[-1] < vertex_count:
        bounds.append(2 * bounds[-1] - 1)
    place = np.searchsorted(bounds, np.abs(edges[:, 1] - edges[:, 0]), side="right") - 1
    return np.maximum(place, 0), bounds


def _pairs(low: int, high: int, count: int) -> int:
    """Pairs of vertices whose gap is in [low, high)."""
    high = min(high, count)
    return 0 if high <= low else (high - low) * count - (high * (high - 1) - low * (low - 1)) // 2


@dataclass(frozen=True)
class Evidence:
    """Edges between frames at the working point, and what is known of them before any alignment.

    - `graph`: with the noise as information; `noise` of each edge; `reach_m`: usual distance of overlapping views.
    - `prior (E,)`: probability that an edge is right by the order of the views; `in_no_listed_cycle (E,)`.
    - `weight (E,)` of an edge's vote: its odds by the prior, more where cycles close over it.
    - `exhaustive`: whether registration seems to have been tried on all pairs.
    """

    graph: ViewGraph
    noise: Noise
    reach_m: float
    prior: Floats
    in_no_listed_cycle: Bools
    weight: Floats
    exhaustive: bool


def gather(graph: ViewGraph, options: DiagnosisOptions) -> tuple[Evidence, Cycles, Floats]:
    """The evidence, the listed cycles, and the working point (3,) in the axes of each frame."""
    edges, count = graph.edges, graph.vertex_count
    prior = order_prior(edges, count) if options.order_prior else np.full(len(edges), 0.5)
    point, reach_m = working_point(graph.i_from_j, prior)
    there = recentred(graph, point)
    loops = short_cycles(edges, count, CYCLES_PER_EDGE)
    errors = cycle_errors(loops, there.i_from_j)
    noise = edge_noise(graph, there, loops, *errors, prior, reach_m)
    cycles = judge_cycles(loops, *errors, noise, reach_m)
    exhaustive = every_pair_tried(edges, count)
    usual = usual_share(cycles)
    if not exhaustive:
        # the rate of joined pairs is no measure of wrong edges then; the cycles are
        prior = right_by_gap(edges, count, cycles, usual) if options.order_prior else np.minimum(prior, usual)
    elif options.order_prior and np.ptp(prior) == 0:
        prior = _if_neighbours_stand_out(edges, right_by_gap(edges, count, cycles, usual))
    support = closing_support(cycles, prior)
    weight = prior / (1 - prior) * (0.5 + support) / (1 + support)
    weight *= 1 + TIE_BREAK * np.random.default_rng(0).random(len(weight))
    known = replace(there, information=noise.information)
    found = Evidence(known, noise, reach_m, prior, loops.missing(len(edges)), weight, exhaustive)
    return found, cycles, point


def working_point(i_from_j: Floats, probability: Floats) -> tuple[Floats, float]:
    """The point (3,) that likely edges move least, `Z c ≈ c`, and the median distance that they move it, metres.

    Overlapping views look at the same things, so that their motion nearly fixes a point in front of them. The origin
    where no point is clearly better.
    """
    likely = probability >= np.quantile(probability, 0.5) if len(probability) else np.zeros(0, bool)
    rotation, shift = i_from_j[likely, :3, :3] - np.eye(3), i_from_j[likely, :3, 3]
    lengths = np.linalg.norm(shift, axis=1)
    usual = float(np.median(lengths)) if len(lengths) else 1.0
    if not len(lengths) or usual == 0:
        return np.zeros(3), usual or 1.0
    weight, point = np.ones(len(shift)), np.zeros(3)
    for _ in range(ROUNDS):
        normal = np.einsum("n,nij,nik->jk", weight, rotation, rotation) + 1e-3 * weight.sum() * np.eye(3)
        point = np.linalg.solve(normal, -np.einsum("n,nij,ni->j", weight, rotation, shift))
        displacement_m = np.linalg.norm(rotation @ point + shift, axis=1)
        weight = 1 / (1 + (displacement_m / max(float(np.median(displacement_m)), 1e-12)) ** 2)
    spread = float(np.median(np.linalg.norm(rotation @ point + shift, axis=1)))
    if np.linalg.norm(point) > FARTHEST * usual or spread > (1 - LEAST_GAIN) * usual:
        return np.zeros(3), usual
    return point, spread
