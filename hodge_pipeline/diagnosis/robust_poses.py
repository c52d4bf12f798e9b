"""Poses of one alignment: the edges that agree with it, solved with heavy-tailed errors, and each edge's χ²."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from hodge_pipeline.complex.components import connected_components
from hodge_pipeline.complex.judging import FREEDOM, left_over, squares_at_both_ends
from hodge_pipeline.diagnosis.evidence import Evidence
from hodge_pipeline.diagnosis.growth import Alignment
from hodge_pipeline.diagnosis.resistance import effective_resistance
from hodge_pipeline.solvers.minimise import descend_isotropic
from hodge_pipeline.solvers.newton import Limits
from hodge_pipeline.solvers.setup import prepare
from hodge_pipeline.types import Bools, Floats, Ints

GATE = 90.0
"""An edge of a larger χ² has no part in the poses."""
ONCE, TWICE = (60.0,), (60.0, GATE)
ANNEALED = (1e4, 1e3, 300.0)
"""Gates for poses that drifted while they grew: edges that they miss by far pull them into place (graduated
non-convexity, Yang et al. 2020), and what does not follow falls out.
"""
DIMENSION = 6.0
"""Of a pose."""
FULLY, ROUGHLY, QUICKLY = (4, Limits(20, 1e-6)), (4, Limits(6, 1e-4)), (4, Limits(10, 1e-4))
"""Rounds of weights and what ends the steps in each: of a solve, of a large graph's, and of a rough one."""
LARGE = 20_000
"""From so many edges on, a solve is stopped early: verdicts need millimetres less than seconds."""


@dataclass(frozen=True)
class Fit(Alignment):
    """Solved poses (V, 4, 4) at the working point, the piece (V,) of each, the χ² (E,) of every edge, allowing for
    the uncertainty of the poses (∞ between pieces), the edges that are used (E,), and the resistance (E,).
    """

    chi2: Floats
    used: Bools
    resistance: Floats

    @property
    def bridge(self) -> Bools:
        """Used edges (E,) that are the only connection between two parts."""
        return self.used & np.isinf(self.resistance)


def fit(evidence: Evidence, alignment: Alignment, gates: tuple[float, ...], *, rough: bool = False) -> Fit:
    """The robust solution that an alignment leads to: for each gate in turn, the edges of a smaller χ² are solved.

    `rough`: quickly and with errors as large as each gate allows, which leads near it whatever the drift.
    """
    found = _as_grown(evidence, alignment)
    for gate, following in zip(gates, (*gates[1:], GATE if rough else math.inf), strict=True):
        used = found.chi2 < gate
        if following < gate and np.array_equal(used, found.chi2 < following):
            continue
        if rough:
            poses = _solve(evidence, found.poses, used, found.chi2 * GATE / gate, QUICKLY, gate / GATE)
            found = _refitted(evidence, poses, used, gate / GATE)
        else:
            how = ROUGHLY if len(used) > LARGE else FULLY
            found = _refitted(evidence, _solve(evidence, found.poses, used, np.full(len(used), DIMENSION), how), used)
    return found


def _as_grown(evidence: Evidence, alignment: Alignment) -> Fit:
    poses, piece = alignment.poses, alignment.piece
    used = piece[evidence.graph.edges[:, 0]] == piece[evidence.graph.edges[:, 1]]
    resistance = effective_resistance(evidence.graph.edges, evidence.graph.vertex_count, used)
    chi2 = chi2_at(evidence, poses, piece, resistance)
    return Fit(piece, poses, chi2, chi2 < GATE, resistance)


def _refitted(evidence: Evidence, poses: Floats, used: Bools, widened: float = 1.0) -> Fit:
    squares = _squares(evidence, poses) / widened
    student_weight = np.where(used, FREEDOM / (FREEDOM + squares), 0.0)
    piece = connected_components(evidence.graph.edges[used], evidence.graph.vertex_count)
    resistance = effective_resistance(evidence.graph.edges, evidence.graph.vertex_count, used)
    chi2 = chi2_at(evidence, poses, piece, resistance, student_weight)
    return Fit(piece, poses, chi2, chi2 < GATE, resistance)


def _solve(
    evidence: Evidence, poses: Floats, used: Bools, squares: Floats, how: tuple[int, Limits], widened: float = 1.0
) -> Floats:
    """The poses (V, 4, 4) that the used edges (E,) lead to, weighed by Student's t, at first for χ² of `squares (E,)`.

    `widened`: how much larger than noise squared errors may be.
    """
    rounds, limits = how
    setup = prepare(evidence.graph.select(np.flatnonzero(used)), poses, dimension=3)
    rotations, translations = setup.initial("given")
    for _ in range(rounds):
        share = ((FREEDOM + DIMENSION) / (FREEDOM + squares[used]))[setup.weights.used]
        problem = replace(setup.problem, kappa=share * setup.problem.kappa, tau=share * setup.problem.tau)
        point = descend_isotropic(problem, (rotations, translations), limits, setup.rounding).point
        rotations, translations, poses = point.rotations, point.translations, setup.poses(point)
        squares = _squares(evidence, poses) / widened
    return poses


def _squares(evidence: Evidence, poses: Floats) -> Floats:
    """χ² (E,) by the noise of the edges, without that of the poses."""
    motions, noise = evidence.graph.i_from_j, evidence.noise
    turned, shifted = squares_at_both_ends(motions, left_over(evidence.graph, poses))
    return np.asarray(turned / noise.rotation_rad**2 + shifted / noise.translation_m**2)


def chi2_at(
    evidence: Evidence, poses: Floats, piece: Ints, resistance: Floats, student_weight: Floats | float = 0.0
) -> Floats:
    """χ² (E,) in the edge's noise and the poses' own: angles drift as a random walk, positions with them.

    `resistance (E,)`: see `Network.between`. For an edge that was used with `student_weight (E,)` the χ² is what it
    would be at poses solved without it.
    """
    graph = evidence.graph
    turned, shifted = squares_at_both_ends(graph.i_from_j, left_over(graph, poses))
    finite_resistance = np.where(np.isfinite(resistance), resistance, 0.0)
    without = (1 + student_weight * finite_resistance) ** 2
    turn, shift = evidence.noise.rotation_rad**2, evidence.noise.translation_m**2
    swing = turn * evidence.reach_m**2 * finite_resistance**3 / 3
    chi2 = turned / (turn * (1 + finite_resistance)) + shifted / (shift * (1 + finite_resistance) + swing)
    apart = piece[graph.edges[:, 0]] != piece[graph.edges[:, 1]]
    return np.where(apart, np.inf, without * chi2)
