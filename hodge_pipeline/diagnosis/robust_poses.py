"""Poses of one alignment: the edges that agree with it, solved with heavy-tailed errors, and each edge's χ²."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.complex.components import connected_components
from hodge_pipeline.diagnosis.evidence import Evidence
from hodge_pipeline.diagnosis.pieces import Alignment
from hodge_pipeline.diagnosis.resistance import effective_resistance
from hodge_pipeline.solvers.minimise import descend_isotropic
from hodge_pipeline.solvers.newton import Limits
from hodge_pipeline.solvers.setup import prepare
from hodge_pipeline.types import Bools, Floats, Ints, ViewGraph

FREEDOM = 4.0
"""Degrees of freedom of Student's t: the tails of real registration errors."""
FIRST_GATE, GATE = 60.0, 90.0
DIMENSION = 6
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


def fit(evidence: Evidence, graph: ViewGraph, alignment: Alignment, rounds: int) -> Fit:
    """The robust solution that an alignment leads to; `graph` holds the recentred edges."""
    poses, component = alignment.piece_from, alignment.piece
    used = component[evidence.edges[:, 0]] == component[evidence.edges[:, 1]]
    resistance = effective_resistance(evidence.edges, evidence.vertex_count, used)
    chi2 = _chi2(evidence, graph, poses, component, resistance, np.zeros(graph.edge_count))
    used = chi2 < FIRST_GATE
    for _ in range(rounds):
        component = connected_components(evidence.edges[used], evidence.vertex_count)
        poses, say = _solve(evidence, graph, poses, used)
        resistance = effective_resistance(evidence.edges, evidence.vertex_count, used)
        chi2 = _chi2(evidence, graph, poses, component, resistance, say)
        used = chi2 < GATE
    return Fit(poses, component, chi2, used, resistance)


def _solve(evidence: Evidence, graph: ViewGraph, poses: Floats, used: Bools) -> tuple[Floats, Floats]:
    """Poses, and what each edge (E,) weighed, 1 for one that fits and 0 for one that is not used."""
    chosen = graph.select(np.flatnonzero(used))
    large = graph.edge_count > LARGE
    limits = Limits(3 if large else 20, 1e-3 if large else 1e-6)
    setup = prepare(chosen, poses, dimension=3)
    rotations, translations = setup.initial("given")
    weight = np.ones(chosen.edge_count)
    for _ in range(2 if large else 4):
        share = weight[setup.weights.used]
        problem = replace(setup.problem, kappa=share * setup.problem.kappa, tau=share * setup.problem.tau)
        point = descend_isotropic(problem, (rotations, translations), limits, setup.rounding).point
        rotations, translations, poses = point.rotations, point.translations, setup.poses(point)
        angle, moved = left_over(chosen, poses)
        squares = (angle / evidence.noise.rotation_rad[used]) ** 2 + (moved / evidence.noise.translation_m[used]) ** 2
        weight = (FREEDOM + DIMENSION) / (FREEDOM + squares)
    say = np.zeros(graph.edge_count)
    say[used] = FREEDOM / (FREEDOM + squares)
    return poses, say


def left_over(graph: ViewGraph, poses: Floats) -> tuple[Floats, Floats]:
    """The angle (E,) in radians and distance (E,) in metres between each edge and the poses."""
    motion = se3.inverse(graph.i_from_j) @ se3.inverse(poses[graph.edges[:, 0]]) @ poses[graph.edges[:, 1]]
    return np.linalg.norm(se3.so3_log(motion[:, :3, :3]), axis=1), np.linalg.norm(motion[:, :3, 3], axis=1)


def _chi2(
    evidence: Evidence, graph: ViewGraph, poses: Floats, component: Ints, resistance: Floats, say: Floats
) -> Floats:
    """χ² (E,) in the edge's noise and the poses' own: angles drift as a random walk, positions with them.

    Of an edge that has its say in the poses, what it would be without that.
    """
    angle, moved = left_over(graph, poses)
    pulled = 1 + say * np.where(np.isfinite(resistance), resistance, 0.0)
    angle, moved = pulled * angle, pulled * moved
    turn, shift = evidence.noise.rotation_rad**2, evidence.noise.translation_m**2
    known = np.where(np.isfinite(resistance), resistance, 0.0)
    swing = turn * evidence.reach_m**2 * known**3 / 3
    chi2 = angle**2 / (turn * (1 + known)) + moved**2 / (shift * (1 + known) + swing)
    apart = component[graph.edges[:, 0]] != component[graph.edges[:, 1]]
    return np.where(apart, np.inf, chi2)
