"""Poses of one alignment: the edges that agree with it, solved with heavy-tailed errors, and each edge's χ²."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from hodge_pipeline.complex.components import connected_components
from hodge_pipeline.complex.judging import FREEDOM, left_over, squares_at_both_ends
from hodge_pipeline.diagnosis.clusters import Quotient, clustered
from hodge_pipeline.diagnosis.evidence import Evidence
from hodge_pipeline.diagnosis.noise import Noise
from hodge_pipeline.diagnosis.pieces import Alignment
from hodge_pipeline.diagnosis.resistance import effective_resistance
from hodge_pipeline.solvers.minimise import descend_isotropic
from hodge_pipeline.solvers.newton import Limits
from hodge_pipeline.solvers.setup import prepare
from hodge_pipeline.types import Bools, Floats, Ints, ViewGraph

GATE = 90.0
"""An edge of a larger χ² has no part in the poses."""
ONCE, TWICE = (60.0,), (60.0, GATE)
ANNEALED = (1e4, 1e3, 300.0)
"""Gates for poses that drifted while they grew: edges that they miss by far pull them into place (graduated
non-convexity, Yang et al. 2020), and what does not follow falls out.
"""
GENTLE = ANNEALED[-1:]
"""For poses that are near already."""
DIMENSION = 6
"""Of a pose."""
FULLY, ROUGHLY, COARSELY = (4, Limits(20, 1e-6)), (4, Limits(6, 1e-4)), (4, Limits(10, 1e-4))
"""Rounds of weights and what ends the steps in each: of a solve, of a large graph's, and of clusters."""
LARGE = 20_000
"""From so many edges on, a solve is stopped early: verdicts need millimetres less than seconds."""


@dataclass(frozen=True)
class Fit:
    """Poses (V, 4, 4) of the recentred frames, the component (V,) of each, the χ² (E,) of every edge, allowing for
    the uncertainty of the poses (∞ between components), the edges that are used (E,), and the resistance (E,).
    """

    poses: Floats
    component: Ints
    chi2: Floats
    used: Bools
    resistance: Floats

    @property
    def bridge(self) -> Bools:
        """Used edges (E,) that are the only connection between two parts."""
        return self.used & np.isinf(self.resistance)


def fit(evidence: Evidence, graph: ViewGraph, alignment: Alignment, gates: tuple[float, ...]) -> Fit:
    """The robust solution that an alignment leads to; `graph` holds the recentred edges.

    For one gate after the other, the edges of a smaller χ² are solved.
    """
    found = _as_grown(evidence, graph, alignment)
    for gate, following in zip(gates, (*gates[1:], math.inf), strict=True):
        used = found.chi2 < gate
        if following < gate and np.array_equal(used, found.chi2 < following):
            continue
        how = ROUGHLY if graph.edge_count > LARGE else FULLY
        squares = np.full(int(used.sum()), float(DIMENSION))
        poses = _solve(evidence.noise.select(used), graph.select(np.flatnonzero(used)), found.poses, squares, how)
        student_weight = np.where(used, FREEDOM / (FREEDOM + _squares(evidence.noise, graph, poses)), 0.0)
        found = _refitted(evidence, graph, poses, used, student_weight)
    return found


def rough_fit(evidence: Evidence, graph: ViewGraph, alignment: Alignment, gates: tuple[float, ...] = ANNEALED) -> Fit:
    """The same with clusters of poses moved as one, and errors as large as each gate allows: near the
    robust solution, whatever the drift, at little cost.
    """
    found = _as_grown(evidence, graph, alignment)
    cluster = clustered(evidence.edges, found.chi2 < GATE, evidence.vertex_count)
    for gate, following in zip(gates, (*gates[1:], GATE), strict=True):
        used, widened = found.chi2 < gate, gate / GATE
        if np.array_equal(used, found.chi2 < following):
            continue
        parts = Quotient.of(graph, evidence.noise, used, cluster, found.poses)
        squares = found.chi2[parts.rows] / widened
        poses = parts.whole(_solve(parts.noise, parts.graph, parts.poses, squares, COARSELY, widened))
        student_weight = np.where(used, FREEDOM / (FREEDOM + _squares(evidence.noise, graph, poses) / widened), 0.0)
        found = _refitted(evidence, graph, poses, used, student_weight)
    return found


def _as_grown(evidence: Evidence, graph: ViewGraph, alignment: Alignment) -> Fit:
    poses, component = alignment.piece_from, alignment.piece
    used = component[evidence.edges[:, 0]] == component[evidence.edges[:, 1]]
    resistance = effective_resistance(evidence.edges, evidence.vertex_count, used)
    chi2 = _chi2(evidence, graph, poses, component, resistance, np.zeros(graph.edge_count))
    return Fit(poses, component, chi2, chi2 < GATE, resistance)


def _refitted(evidence: Evidence, graph: ViewGraph, poses: Floats, used: Bools, student_weight: Floats) -> Fit:
    component = connected_components(evidence.edges[used], evidence.vertex_count)
    resistance = effective_resistance(evidence.edges, evidence.vertex_count, used)
    chi2 = _chi2(evidence, graph, poses, component, resistance, student_weight)
    return Fit(poses, component, chi2, chi2 < GATE, resistance)


def _solve(
    noise: Noise, graph: ViewGraph, poses: Floats, squares: Floats, how: tuple[int, Limits], widened: float = 1.0
) -> Floats:
    """The poses (V, 4, 4) that all edges lead to, weighed by Student's t, at first for χ² of `squares (E,)`.

    `widened`: how much larger than noise squared errors may be.
    """
    rounds, limits = how
    setup = prepare(graph, poses, dimension=3)
    rotations, translations = setup.initial("given")
    for _ in range(rounds):
        share = ((FREEDOM + DIMENSION) / (FREEDOM + squares))[setup.weights.used]
        problem = replace(setup.problem, kappa=share * setup.problem.kappa, tau=share * setup.problem.tau)
        point = descend_isotropic(problem, (rotations, translations), limits, setup.rounding).point
        rotations, translations, poses = point.rotations, point.translations, setup.poses(point)
        squares = _squares(noise, graph, poses) / widened
    return poses


def _squares(noise: Noise, graph: ViewGraph, poses: Floats) -> Floats:
    """χ² (E,) by the noise of the edges, without that of the poses."""
    turned, shifted = squares_at_both_ends(graph.i_from_j, left_over(graph, poses))
    return np.asarray(turned / noise.rotation_rad**2 + shifted / noise.translation_m**2)


def chi2_at(evidence: Evidence, graph: ViewGraph, poses: Floats, component: Ints, resistance: Floats) -> Floats:
    """χ² (E,) of each edge at poses that none of these edges was used for; `resistance (E,)`: see `Network.between`."""
    return _chi2(evidence, graph, poses, component, resistance, np.zeros(graph.edge_count))


def _chi2(
    evidence: Evidence, graph: ViewGraph, poses: Floats, component: Ints, resistance: Floats, student_weight: Floats
) -> Floats:
    """χ² (E,) in the edge's noise and the poses' own: angles drift as a random walk, positions with them.

    For an edge that was used with `student_weight (E,)` the χ² is what it would be at poses solved without it.
    """
    turned, shifted = squares_at_both_ends(graph.i_from_j, left_over(graph, poses))
    finite_resistance = np.where(np.isfinite(resistance), resistance, 0.0)
    without = (1 + student_weight * finite_resistance) ** 2
    turn, shift = evidence.noise.rotation_rad**2, evidence.noise.translation_m**2
    swing = turn * evidence.reach_m**2 * finite_resistance**3 / 3
    chi2 = turned / (turn * (1 + finite_resistance)) + shifted / (shift * (1 + finite_resistance) + swing)
    apart = component[graph.edges[:, 0]] != component[graph.edges[:, 1]]
    return np.where(apart, np.inf, without * chi2)
