"""Poses of one alignment: the edges that agree with it, solved with heavy-tailed errors, and each edge's χ²."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from hodge_pipeline.complex.chi2 import FREEDOM, STUDENT_99, residual_twists, squares_at_both_ends, tail_weight
from hodge_pipeline.complex.components import connected_components
from hodge_pipeline.diagnosis.evidence import Evidence
from hodge_pipeline.diagnosis.growth import Alignment
from hodge_pipeline.solvers.minimise import descend_isotropic
from hodge_pipeline.solvers.newton import Limits
from hodge_pipeline.solvers.resistance import Network, effective_resistance
from hodge_pipeline.solvers.setup import InitialName, prepare
from hodge_pipeline.types import Bools, Floats, Ints

GATE, UNSETTLED = STUDENT_99[6], 60.0
"""χ² gates of edges for a solve: the final one, and one for poses that are not yet final."""
ONCE, TWICE = (UNSETTLED,), (UNSETTLED, GATE)
ANNEALED = (1e4, 1e3, 300.0)
"""Decreasing gates for poses that drifted in growth: edges far off pull them into place before they are dropped
(graduated non-convexity, Yang et al. 2020).
"""
ROUNDS = 4
"""Reweighting rounds of a solve."""
FULLY, QUICKLY = Limits(20, 1e-6), Limits(6, 1e-4)
"""Step limits and tolerances of a round: `QUICKLY` for wide gates and large graphs."""
LARGE = 20_000
"""Number of edges beyond which solves are stopped early: verdicts do not need millimetres."""


@dataclass(frozen=True)
class Solved(Alignment):
    """Solved poses at the working point, and each edge judged by them.

    `chi2 (E,)`: allowing for the uncertainty of the poses, ∞ between pieces; `used (E,)`: within the gate;
    `resistance (E,)`: effective resistance between the ends without the edge, ∞ for a bridge.
    """

    chi2: Floats
    used: Bools
    resistance: Floats

    @property
    def bridge(self) -> Bools:
        """Used edges (E,) that are the only connection between two parts."""
        return self.used & np.isinf(self.resistance)


def fit(evidence: Evidence, alignment: Alignment, gates: tuple[float, ...], initial: InitialName = "given") -> Solved:
    """The robust solution from an alignment: for each gate in turn, the edges of smaller χ² are solved.

    With gates wider than `GATE` few steps are made, and noise is scaled up to the gate, so that drift does not matter.
    `initial`: what each solve starts from, the poses before it or chordal ones of the edges within its gate.
    """
    apart = np.not_equal(*alignment.piece[evidence.graph.edges.T])
    found = _with_chi2(evidence, alignment.poses, alignment.piece, ~apart, 0.0)
    for gate, following in zip(gates, (*gates[1:], GATE if gates[-1] > GATE else math.inf), strict=True):
        used = found.chi2 < gate
        if following < gate and np.array_equal(used, found.chi2 < following):
            continue
        rough, widened = gate > GATE, max(gate / GATE, 1.0)
        first = found.chi2 / widened if rough else np.full(len(used), 6.0)
        limits = QUICKLY if rough or len(used) > LARGE else FULLY
        poses, squares = _solve(evidence, found.poses, used, first, limits, widened, initial)
        piece = connected_components(evidence.graph.edges[used], evidence.graph.vertex_count)
        found = _with_chi2(evidence, poses, piece, used, np.where(used, FREEDOM / (FREEDOM + squares), 0.0))
    return found


def _with_chi2(evidence: Evidence, poses: Floats, piece: Ints, used: Bools, student_weight: Floats | float) -> Solved:
    network = Network.of(evidence.graph.edges[used], evidence.graph.vertex_count)
    resistance = effective_resistance(evidence.graph.edges, used, network)
    chi2 = chi2_at(evidence, poses, piece, resistance, student_weight)
    return Solved(piece, poses, chi2, chi2 < GATE, resistance)


def _solve(
    evidence: Evidence,
    poses: Floats,
    used: Bools,
    squares: Floats,
    limits: Limits,
    widened: float,
    initial: InitialName,
) -> tuple[Floats, Floats]:
    """The poses (V, 4, 4) of the used edges (E,), reweighted by Student's t, at first for χ² `squares (E,)`; and the χ²
    (E,) by the noise of the edges alone, divided by `widened`.

    `widened`: how much larger than noise squared errors may be.
    """
    setup = prepare(evidence.graph.select(np.flatnonzero(used)), poses, dimension=3)
    rotations, translations = setup.initial(initial)
    exact = np.zeros(len(poses), np.int64), np.zeros(len(used))
    for _ in range(ROUNDS):
        share = tail_weight(squares[used], 6)[setup.weights.used]
        problem = replace(setup.problem, kappa=share * setup.problem.kappa, tau=share * setup.problem.tau)
        point = descend_isotropic(problem, (rotations, translations), limits, setup.rounding).point
        rotations, translations, poses = point.rotations, point.translations, setup.poses(point)
        squares = chi2_at(evidence, poses, *exact) / widened
    return poses, squares


def chi2_at(
    evidence: Evidence, poses: Floats, piece: Ints, resistance: Floats, student_weight: Floats | float = 0.0
) -> Floats:
    """χ² (E,) by the noise of the edge and of the poses, whose rotations drift as a random walk and move positions; ∞
    between pieces (V,).

    `resistance (E,)`: see `Network.between`; 0 where the poses are exact. For an edge that was used with
    `student_weight (E,)` the χ² is what it would be at poses solved without it.
    """
    graph = evidence.graph
    turned, shifted = squares_at_both_ends(graph.i_from_j, residual_twists(graph, poses))
    finite_resistance = np.where(np.isfinite(resistance), resistance, 0.0)
    turn, shift = evidence.noise.rotation_rad**2, evidence.noise.translation_m**2
    swing = turn * evidence.reach_m**2 * finite_resistance**3 / 3
    chi2 = turned / (turn * (1 + finite_resistance)) + shifted / (shift * (1 + finite_resistance) + swing)
    chi2 *= (1 + student_weight * finite_resistance) ** 2
    return np.where(np.not_equal(*piece[graph.edges.T]), np.inf, chi2)


def meets_no_loops(evidence: Evidence, found: Solved) -> bool:
    """Whether most used edges between views that are not consecutive are beyond the gate at these poses, by their own
    noise alone: the poses are then those of the consecutive edges.
    """
    loops = found.used & (np.abs(np.diff(evidence.graph.edges, axis=1)[:, 0]) > 1)
    off = chi2_at(evidence, found.poses, found.piece, np.zeros(len(loops))) > GATE
    return bool(2 * off[loops].sum() > loops.sum())
