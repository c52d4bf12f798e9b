"""The measured edges of a graph around the centroid of each component, and the Poisson equation on their vertices."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.sparse import csr_matrix

from hodge_pipeline import se3
from hodge_pipeline.complex.checks import orthonormal
from hodge_pipeline.complex.components import connected_components
from hodge_pipeline.complex.edge_weights import edge_weights
from hodge_pipeline.complex.one_form import Logarithm, centroids, residual_form, shifted
from hodge_pipeline.errors import GraphError
from hodge_pipeline.solvers.potential import moved, poisson, residual_metrics
from hodge_pipeline.solvers.problem import pinned_vertices
from hodge_pipeline.types import Floats, Ints, ViewGraph

LEVER_ARM_M = 1.0  # a rotation counts as the displacement that it causes this far away, in a path's uncertainty


@dataclass(frozen=True)
class PaperProblem:
    """The edges that join two vertices, in the order and orientation of the complex, and the centred start poses.

    - `rows (E,)` of the graph's edges, sorted by their vertices, so that the surface and its random orders depend
      neither on the order in which edges were measured nor on their directions;
    - `edges (E, 2)` and `i_from_j (E, 4, 4)` with i < j; `sign (E,)` is −1 where the measurement ran from j to i.

    The poses are around the centroid of their component: far from the world's origin a little rotation would be much
    translation, and ω would depend on where the origin is.
    """

    rows: Ints
    edges: Ints
    i_from_j: Floats
    sign: Ints
    component: Ints
    fixed: Ints
    start: Floats
    offset: Floats
    start_in_world: Floats
    self_loops: int

    def form(self, poses: Floats, log: Logarithm) -> Floats:
        """ω (E, 6) of the edges i < j: taken in the direction measured, its sign turned where that is j to i."""
        backwards = self.sign < 0
        as_measured = np.where(backwards[:, None], self.edges[:, ::-1], self.edges)
        motions = self.i_from_j.copy()
        motions[backwards] = se3.inverse(motions[backwards])
        return np.asarray(self.sign[:, None] * residual_form(as_measured, motions, poses, log))

    def in_world(self, poses: Floats) -> Floats:
        """The poses away from the centroid again; the held vertices are those of the start to the last bit."""
        out = shifted(poses, self.offset)
        held = pinned_vertices(self.component, self.fixed)
        out[held] = self.start_in_world[held]
        return out

    def poisson(self, d0: csr_matrix, weights: Floats) -> Callable[[Floats], Floats]:
        """From ω (edges of d0, 6) to f (V, 6), `d0ᵀ W d0 f = d0ᵀ W ω` (Eq. (7)); see `potential.poisson`."""
        return poisson(d0, weights, self.component, self.fixed)

    def moved(self, poses: Floats, correction: Floats, log: Logarithm) -> Floats:
        """`exp(f_k) T_k` (V, 4, 4), with the held vertices at their start; see `potential.moved`."""
        return moved(poses, correction, self.start, self.component, self.fixed, log)

    def residual_metrics(self, poses: Floats) -> Mapping[str, float]:
        """Mean and median disagreement of the edges with the poses, metres and radians."""
        return residual_metrics(self.edges, self.i_from_j, poses)

    def notes(self) -> tuple[str, ...]:
        """What was ignored."""
        if not self.self_loops:
            return ()
        return (f"{self.self_loops} edges join a vertex to itself and say nothing about poses: ignored",)


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


def path_lengths(graph: ViewGraph, kind: Literal["hops", "uncertainty"]) -> Floats:
    """The length (E,) of each edge for Algorithm 2: 1, or its standard deviation in metres.

    The deviation is the root of the edge's mean variance, rotations counted as displacements 1 m away.
    """
    if kind == "hops":
        return np.ones(graph.edge_count)
    weights, _ = edge_weights(graph, "information", LEVER_ARM_M)
    if not (weights > 0).all():
        bad = int((weights <= 0).sum())
        raise GraphError(
            f"paths: uncertainty needs positive information, {bad} of {len(weights)} edges have none: hops"
        )
    return np.asarray(1.0 / np.sqrt(weights))
