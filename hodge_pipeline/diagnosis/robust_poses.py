"""Poses of one alignment: the edges that agree with it, solved with heavy-tailed errors, and each edge's χ²."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra

from hodge_pipeline import se3
from hodge_pipeline.complex.components import connected_components, first_of_component
from hodge_pipeline.complex.judging import FREEDOM, left_over, squares_at_both_ends
from hodge_pipeline.diagnosis.evidence import Evidence
from hodge_pipeline.diagnosis.growth import Alignment
from hodge_pipeline.diagnosis.noise import Noise
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


CLUSTERS = 6000
"""Of poses that are moved as one, at most, in a graph that holds together; with no more poses than this each is one."""
ACROSS = 2 / 3
"""Of the squared lever: the share at right angles to it, along which an error of rotation swings, of a mean axis."""


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


def fit(evidence: Evidence, alignment: Alignment, gates: tuple[float, ...]) -> Fit:
    """The robust solution that an alignment leads to.

    For one gate after the other, the edges of a smaller χ² are solved.
    """
    graph, found = evidence.graph, _as_grown(evidence, alignment)
    for gate, following in zip(gates, (*gates[1:], math.inf), strict=True):
        used = found.chi2 < gate
        if following < gate and np.array_equal(used, found.chi2 < following):
            continue
        how = ROUGHLY if graph.edge_count > LARGE else FULLY
        squares = np.full(int(used.sum()), float(DIMENSION))
        poses = _solve(evidence.noise.select(used), graph.select(np.flatnonzero(used)), found.poses, squares, how)
        found = _refitted(evidence, poses, used)
    return found


def rough_fit(evidence: Evidence, alignment: Alignment, gates: tuple[float, ...] = ANNEALED) -> Fit:
    """The same with clusters of poses moved as one, and errors as large as each gate allows: near the
    robust solution, whatever the drift, at little cost.
    """
    found = _as_grown(evidence, alignment)
    cluster = clustered(evidence.edges, found.chi2 < GATE, evidence.vertex_count)
    for gate, following in zip(gates, (*gates[1:], GATE), strict=True):
        used, widened = found.chi2 < gate, gate / GATE
        if np.array_equal(used, found.chi2 < following):
            continue
        parts = Quotient.of(evidence.graph, evidence.noise, used, cluster, found.poses)
        squares = found.chi2[parts.rows] / widened
        poses = parts.whole(_solve(parts.noise, parts.graph, parts.poses, squares, COARSELY, widened))
        found = _refitted(evidence, poses, used, widened)
    return found


def _as_grown(evidence: Evidence, alignment: Alignment) -> Fit:
    poses, piece = alignment.poses, alignment.piece
    used = piece[evidence.edges[:, 0]] == piece[evidence.edges[:, 1]]
    resistance = effective_resistance(evidence.edges, evidence.vertex_count, used)
    chi2 = chi2_at(evidence, poses, piece, resistance)
    return Fit(piece, poses, chi2, chi2 < GATE, resistance)


def _refitted(evidence: Evidence, poses: Floats, used: Bools, widened: float = 1.0) -> Fit:
    squares = _squares(evidence.noise, evidence.graph, poses) / widened
    student_weight = np.where(used, FREEDOM / (FREEDOM + squares), 0.0)
    piece = connected_components(evidence.edges[used], evidence.vertex_count)
    resistance = effective_resistance(evidence.edges, evidence.vertex_count, used)
    chi2 = chi2_at(evidence, poses, piece, resistance, student_weight)
    return Fit(piece, poses, chi2, chi2 < GATE, resistance)


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


def clustered(edges: Ints, firm: Bools, vertex_count: int) -> Ints:
    """The cluster (V,) of each vertex: those nearest, along the firm edges (E,), to one of some thousand seeds."""
    ends = edges[firm]
    shape = (vertex_count, vertex_count)
    adjacency = csr_matrix((np.ones(len(ends), np.float32), (ends[:, 0], ends[:, 1])), shape=shape)
    seed = first_of_component(connected_components(ends, vertex_count))
    seed |= np.random.default_rng(0).random(vertex_count) < CLUSTERS / max(vertex_count, 1)
    seeds = np.flatnonzero(seed)
    nearest = dijkstra(adjacency, False, seeds, return_predecessors=True, unweighted=True, min_only=True)[2]
    return np.asarray(np.searchsorted(seeds, nearest), np.int64)


@dataclass(frozen=True)
class Quotient:
    """The graph of clusters, each at the mean position of its poses, and the noise of its edges, which are `rows (m,)`
    of the whole graph's; `poses (C, 4, 4)` of the clusters, `cluster_from (V, 4, 4)` of the vertices in theirs.
    """

    rows: Ints
    graph: ViewGraph
    noise: Noise
    poses: Floats
    cluster: Ints
    cluster_from: Floats

    @classmethod
    def of(cls, graph: ViewGraph, noise: Noise, used: Bools, cluster: Ints, poses: Floats) -> Quotient:
        """The quotient by clusters (V,) at poses (V, 4, 4), with the used edges (E,) between two of them."""
        centres = _centres(cluster, poses)
        at = se3.from_parts(np.eye(3), centres)
        cluster_from = se3.inverse(at)[cluster] @ poses
        ends = cluster[graph.edges]
        rows = np.flatnonzero(used & (ends[:, 0] != ends[:, 1]))
        i, j = graph.edges[rows].T
        motion = cluster_from[i] @ graph.i_from_j[rows] @ se3.inverse(cluster_from[j])
        levers = ((cluster_from[i, :3, 3] ** 2).sum(axis=1) + (cluster_from[j, :3, 3] ** 2).sum(axis=1)) / 2
        turn = noise.rotation_rad[rows]
        own = Noise(turn, np.sqrt(noise.translation_m[rows] ** 2 + ACROSS * turn**2 * levers))
        coarse = ViewGraph.from_edges(np.arange(len(centres)), ends[rows], motion, own.information)
        return cls(rows, coarse, own, at, cluster, cluster_from)

    def whole(self, poses: Floats) -> Floats:
        """The poses (V, 4, 4) that follow from those of the clusters."""
        return np.asarray(poses[self.cluster] @ self.cluster_from)


def _centres(cluster: Ints, poses: Floats) -> Floats:
    count = int(cluster.max(initial=-1)) + 1
    sums = [np.bincount(cluster, poses[:, axis, 3], count) for axis in range(3)]
    return np.stack(sums, axis=1) / np.bincount(cluster, minlength=count)[:, None]
