"""The measured edges of a graph around the centroid of each component, in the order of the complex."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.complex.checks import orthonormal
from hodge_pipeline.complex.components import connected_components
from hodge_pipeline.complex.one_form import Logarithm, centroids, residual_form, shifted
from hodge_pipeline.solvers.potential import CentredProblem
from hodge_pipeline.types import Floats, Ints, ViewGraph


@dataclass(frozen=True)
class PaperProblem(CentredProblem):
    """The edges that join two vertices, in the order and orientation of the complex, and the centred start poses.

    - `rows (E,)` of the graph's edges, sorted by their vertices, so that the surface and its random orders depend
      neither on the order in which edges were measured nor on their directions;
    - `edges (E, 2)` and `i_from_j (E, 4, 4)` with i < j; `sign (E,)` is −1 where the measurement ran from j to i.
    """

    rows: Ints
    sign: Ints
    self_loops: int

    def form(self, poses: Floats, log: Logarithm) -> Floats:
        """ω (E, 6) of the edges i < j: taken in the direction measured, its sign turned where that is j to i."""
        backwards = self.sign < 0
        as_measured = np.where(backwards[:, None], self.edges[:, ::-1], self.edges)
        motions = self.i_from_j.copy()
        motions[backwards] = se3.inverse(motions[backwards])
        return np.asarray(self.sign[:, None] * residual_form(as_measured, motions, poses, log))

    def notes(self) -> tuple[str, ...]:
        """What was ignored."""
        if not self.self_loops:
            return ()
        return (f"{self.self_loops} edges join a vertex to itself and hold no information on poses: ignored",)


def make_problem(graph: ViewGraph, world_from_cam: Floats) -> PaperProblem:
    """The problem of a checked graph; edges that join a vertex to itself are left out."""
    low, high = graph.edges.min(axis=1), graph.edges.max(axis=1)
    order = np.lexsort((high, low))
    rows = order[(low < high)[order]]
    edges = np.stack([low[rows], high[rows]], axis=1)
    backwards = graph.edges[rows, 0] > graph.edges[rows, 1]
    i_from_j = orthonormal(graph.i_from_j[rows])
    i_from_j[backwards] = se3.inverse(i_from_j[backwards])
    component = connected_components(edges, graph.vertex_count)
    offset = centroids(world_from_cam, component)
    return PaperProblem(
        rows=rows,
        edges=edges,
        i_from_j=i_from_j,
        sign=np.where(backwards, -1, 1),
        component=component,
        fixed=graph.fixed,
        start=orthonormal(shifted(world_from_cam, -offset)),
        offset=offset,
        start_in_world=world_from_cam,
        self_loops=graph.edge_count - len(rows),
    )
