"""Poses of a model's bodies consistent with all its edges, and how well the edges fix each position."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.complex.chi2 import MEDIAN_CHI2, chi2_by_information
from hodge_pipeline.complex.closing import TRIANGLES_PER_EDGE
from hodge_pipeline.complex.short_cycles import short_cycles
from hodge_pipeline.errors import GraphError
from hodge_pipeline.evaluation.residuals import with_residuals
from hodge_pipeline.solvers.covariance import marginal_covariances
from hodge_pipeline.stages import ConsistencySolver
from hodge_pipeline.types import Edges, Floats, PositionPriors, Solution, ViewGraph

ROUNDS = 2
"""Solves, each with information calibrated at the last poses, on which that of edges without cycles depends."""
LEAST_TRIANGLES = 10
"""Fewest triangles whose median counts."""


@dataclass(frozen=True)
class Solved:
    """The graph with calibrated information, and the solution of it."""

    graph: ViewGraph
    solution: Solution

    def edges(self, world_from_body: Floats) -> Edges:
        """The table of the edges with their residuals at the poses (B, 4, 4)."""
        return with_residuals(Edges.measured(self.graph), world_from_body, self.solution.weights)


def calibrated(graph: ViewGraph, world_from_body: Floats) -> ViewGraph:
    """The graph with the information of each kind of edge (`source`) scaled to fit how well its triangles close.

    The median χ² of a kind's triangles becomes that of the distribution; of a kind with few triangles, the median χ² of
    its edges at the poses (B, 4, 4). Registrars and two-view geometry know nothing of errors that their points share
    (lens, sensor warp), so each kind is overconfident by a factor of its own. Triangles do not depend on the poses,
    which may be wrong.
    """
    factor = np.ones(graph.edge_count)
    for source in np.unique(graph.source):
        same = graph.source == source
        kind = graph.select(np.flatnonzero(same))
        chi2 = triangle_chi2(kind)
        if len(chi2) < LEAST_TRIANGLES:
            chi2 = chi2_by_information(kind, world_from_body)
        middle = float(np.median(chi2))
        factor[same] = MEDIAN_CHI2[6] / middle if middle > 0 else 1.0
    return replace(graph, information=graph.information * factor[:, None, None])


def triangle_chi2(graph: ViewGraph) -> Floats:
    """χ² (T,) of the motion round each triangle of edges, by the covariances of its three edges, propagated."""
    loops = short_cycles(graph.edges, graph.vertex_count, TRIANGLES_PER_EDGE)
    first = loops.offsets[:-1][loops.lengths == 3]
    at = first[:, None] + np.arange(3)
    edge, forward = loops.edge[at], (loops.sign[at] > 0)[..., None, None]
    motion = np.where(forward, graph.i_from_j[edge], se3.inverse(graph.i_from_j[edge]))
    covariance = np.linalg.pinv(graph.information, hermitian=True)[edge]
    covariance = np.where(forward, covariance, se3.carried(graph.i_from_j[edge], covariance))
    total, rest = np.zeros((len(at), 6, 6)), np.broadcast_to(np.eye(4), (len(at), 4, 4))
    for number in (2, 1, 0):
        total = total + se3.carried(se3.inverse(rest), covariance[:, number])
        rest = motion[:, number] @ rest
    xi = se3.log(rest)
    return np.asarray(np.einsum("ta,tab,tb->t", xi, np.linalg.pinv(total, hermitian=True), xi))


def solve_bodies(graph: ViewGraph, world_from_body: Floats, solver: ConsistencySolver) -> Solved:
    """The consistent poses of the bodies, from the model's own (B, 4, 4), with calibrated information."""
    poses = world_from_body
    for _ in range(ROUNDS):
        weighted = calibrated(graph, poses)
        solution = solver.solve(weighted, poses)
        poses = solution.world_from_cam
    return Solved(weighted, solution)


def position_priors(solved: Solved) -> PositionPriors | None:
    """The solved position of each body with the marginal covariance that its edges leave; NaN without an edge.

    A body that fixes the gauge has no covariance: it takes the mean of the others'. None where there are no others, or
    the graph is singular.
    """
    poses = solved.solution.world_from_cam
    kept = solved.graph.select(np.flatnonzero(solved.solution.kept))
    rows = np.unique(kept.edges)
    if not len(rows):
        return None
    try:
        covariance = marginal_covariances(kept, poses, rows)[:, 3:, 3:]
    except GraphError:
        return None
    turned = poses[rows, :3, :3] @ covariance @ np.swapaxes(poses[rows, :3, :3], 1, 2)
    held = np.trace(turned, axis1=1, axis2=2) <= 0
    if held.all():
        return None
    turned[held] = turned[~held].mean(axis=0)
    covariances = np.full((len(poses), 3, 3), np.nan)
    covariances[rows] = turned
    return PositionPriors(poses[:, :3, 3].copy(), covariances)
