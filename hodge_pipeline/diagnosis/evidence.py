"""What the edges show before any alignment: the noise of those in cycles that close, and how likely each is right."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.diagnosis.noise import Noise, edge_noise
from hodge_pipeline.diagnosis.options import DiagnosisOptions
from hodge_pipeline.diagnosis.order import every_pair_tried, order_prior, prior_by_cycles, right_by_gap
from hodge_pipeline.diagnosis.result import Cycles
from hodge_pipeline.diagnosis.short_cycles import closing_support, cycle_errors, judge_cycles, short_cycles, usual_share
from hodge_pipeline.types import Bools, Floats, Ints, ViewGraph

ROUNDS = 20
FARTHEST = 2.0
"""Of the median translation: a point further off is a turning circle, not something that is seen."""
LEAST_GAIN = 0.3
TIE_BREAK = 1e-3
"""Of a weight: with equal ones a chain would be joined one edge a round."""


@dataclass(frozen=True)
class Evidence:
    """Edges between frames at the working point, and what can be computed of them before any alignment.

    - `graph`: with the noise as information; `noise` of each edge; `reach_m`: how far overlapping views lie apart.
    - `prior (E,)`: probability of being right by the order of the views; `support (E,)`: how many cycles close over
      the edge, whose edges are likely right; `in_no_listed_cycle (E,)`.
    - `weight (E,)` of an edge's vote; `cluster_gain` nats for each e-fold of those that agree.
    - `exhaustive`: whether registration seems to have been tried on all pairs.
    """

    graph: ViewGraph
    noise: Noise
    reach_m: float
    prior: Floats
    support: Floats
    in_no_listed_cycle: Bools
    weight: Floats
    cluster_gain: float
    exhaustive: bool

    def select(self, rows: Ints) -> Evidence:
        """That of these edges among all vertices."""
        edges = {name: getattr(self, name)[rows] for name in ("prior", "support", "in_no_listed_cycle", "weight")}
        return replace(self, graph=self.graph.select(rows), noise=self.noise.select(rows), **edges)


def gather(graph: ViewGraph, options: DiagnosisOptions) -> tuple[Evidence, Cycles, Floats]:
    """The evidence, the cycles that were listed, and the working point (3,) in the axes of each frame."""
    edges, count = graph.edges, graph.vertex_count
    prior = order_prior(edges, count) if options.order_prior else np.full(len(edges), 0.5)
    point, reach_m = working_point(graph.i_from_j, prior)
    motions = recentred(graph.i_from_j, point)
    loops = short_cycles(edges, count, options.max_cycles_per_edge)
    errors = cycle_errors(loops, motions)
    noise = edge_noise(graph, loops, *errors, prior, reach_m)
    cycles = judge_cycles(loops, *errors, noise, reach_m)
    exhaustive = every_pair_tried(edges, count)
    if exhaustive and options.order_prior and np.ptp(prior) == 0:
        prior = prior_by_cycles(edges, count, cycles)
        noise = edge_noise(graph, loops, *errors, prior, reach_m)
        cycles = judge_cycles(loops, *errors, noise, reach_m)
    if not exhaustive:
        # then the order cannot tell how many of the pairs that were tried are wrong: the cycles can
        usual = usual_share(cycles)
        prior = right_by_gap(edges, count, cycles, usual) if options.order_prior else np.minimum(prior, usual)
    unlisted = np.ones(len(edges), bool)
    unlisted[loops.edge] = False
    support = closing_support(cycles, prior)
    weight = prior / (1 - prior) * (0.5 + support) / (1 + support)
    weight *= 1 + TIE_BREAK * np.random.default_rng(options.seed).random(len(weight))
    known = replace(graph, i_from_j=motions, information=noise.information)
    found = Evidence(known, noise, reach_m, prior, support, unlisted, weight, options.cluster_gain, exhaustive)
    return found, cycles, point


def working_point(i_from_j: Floats, probability: Floats) -> tuple[Floats, float]:
    """The point (3,) that likely edges move least, `Z c ≈ c`, and how far they move it (median).

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


def recentred(i_from_j: Floats, point: Floats) -> Floats:
    """The motions (E, 4, 4) between frames that are moved to the point: `S⁻¹ Z S`."""
    shift = se3.from_parts(np.eye(3), point)
    return np.asarray(se3.inverse(shift) @ i_from_j @ shift)
