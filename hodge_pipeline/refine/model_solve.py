"""The poses of a model's bodies that agree with all its edges, and how well the edges fix each position."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.complex.chi2 import chi2_by_information
from hodge_pipeline.complex.short_cycles import short_cycles
from hodge_pipeline.errors import GraphError
from hodge_pipeline.evaluation.residuals import with_residuals
from hodge_pipeline.solvers.covariance import marginal_covariances
from hodge_pipeline.stages import ConsistencySolver
from hodge_pipeline.types import Edges, Floats, PositionPriors, Solution, ViewGraph

MEDIAN_CHI2 = 5.348
"""Of χ² with six degrees of freedom."""
OUTLIER_CHI2 = 16.812
"""Its 99 % quantile."""
ROUNDS = 2
LEAST_TRIANGLES, TRIANGLES_PER_EDGE = 10, 8
"""Below it their median says little; of each edge so many serve."""
KEPT = 1e-3


@dataclass(frozen=True)
class Solved:
    """The graph with its information set right, the solution on it, and which of its edges count (E,)."""

    graph: ViewGraph
    solution: Solution

    @property
    def kept(self) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
        """The edges (E,) that agree with the poses."""
        return np.asarray(self.solution.weights > KEPT)

    def edges(self, world_from_body: Floats) -> Edges:
        """The edges with what they miss the poses (B, 4, 4) by."""
        return with_residuals(Edges.measured(self.graph), world_from_body, self.solution.weights)

    def chi2(self, world_from_body: Floats) -> float:
        """The mean over all edges of χ² per degree of freedom, an outlier's cut off where the solver cuts it."""
        squares = np.minimum(chi2_by_information(self.graph, world_from_body), OUTLIER_CHI2)
        return float(squares.mean() / 6) if len(squares) else float("nan")


def calibrated(graph: ViewGraph, world_from_body: Floats) -> ViewGraph:
    """The graph with the information of each kind of edge scaled so that half of its triangles close within the median
    of χ²; of a kind with few triangles, so that half of its edges fit the poses.

    What a registrar or a two-view geometry says of itself leaves out what its points share (the lens, the sensor's
    warp), so it is too sure, each kind by a factor of its own. The poses may be the disturbed ones: cycles are not.
    """
    factor = np.ones(graph.edge_count)
    for source in np.unique(graph.source):
        same = graph.source == source
        kind = graph.select(np.flatnonzero(same))
        chi2 = triangle_chi2(kind)
        if len(chi2) < LEAST_TRIANGLES:
            chi2 = chi2_by_information(kind, world_from_body)
        middle = float(np.median(chi2))
        factor[same] = MEDIAN_CHI2 / middle if middle > 0 else 1.0
    return replace(graph, information=graph.information * factor[:, None, None])


def triangle_chi2(graph: ViewGraph) -> Floats:
    """χ² (T,) of the motion that each triangle of edges leaves over, by the covariances of its three edges."""
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
    """The consistent poses, from the model's own; the noise of edges without cycles is taken at those so far."""
    poses = world_from_body
    for _ in range(ROUNDS):
        right = calibrated(graph, poses)
        solution = solver.solve(right, poses)
        poses = solution.world_from_cam
    return Solved(right, solution)


def position_priors(solved: Solved) -> PositionPriors | None:
    """Where the solution puts each body, as sure as its edges are; none of bodies that no edge holds.

    The bodies that fix the gauge are taken to be as sure as the others on average.
    """
    poses = solved.solution.world_from_cam
    kept = solved.graph.select(np.flatnonzero(solved.kept))
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
