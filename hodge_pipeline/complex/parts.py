"""The 1-form of a viewing graph on its complex, and the energy of its exact, co-exact and harmonic parts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass as options

from hodge_pipeline.complex.cech import (
    SimplicialComplex,
    clique_counts,
    flag_complex,
    nerve,
    orient_edges,
)
from hodge_pipeline.complex.components import connected_components
from hodge_pipeline.complex.decomposition import HodgeDecomposition, hodge_decomposition
from hodge_pipeline.complex.occupancy import voxel_occupancy
from hodge_pipeline.complex.one_form import centroids, residual_form, shifted
from hodge_pipeline.errors import GraphError
from hodge_pipeline.types import CloudSet, Floats, Ints, ViewGraph

MOST_TRIANGLES = 200_000
"""Of a graph with more the parts are not computed: a cost, some seconds of conjugate gradients."""


@options(frozen=True, config=ConfigDict(extra="forbid"))
class ComplexOptions:
    """The Čech complex of the viewing graph (Definition 1 of the paper)."""

    nerve: bool = Field(
        default=False,
        description="keep a triangle only where its three clouds share a voxel, the paper's definition; else every "
        "three frames that are joined in pairs are one (flag complex), which needs no clouds",
    )
    voxel_m: float = Field(default=0.1, gt=0, description="metres: side of the voxels that three clouds must share")

    def of(self, graph: ViewGraph, clouds: CloudSet, world_from_cam: Floats) -> SimplicialComplex:
        """Vertices, edges, triangles of a graph under poses (V, 4, 4). Raises `GraphError` for too many triangles."""
        flag = flag_of(graph)
        return nerve(flag, voxel_occupancy(clouds, world_from_cam, self.voxel_m)[0]) if self.nerve else flag


def flag_of(graph: ViewGraph) -> SimplicialComplex:
    """The flag complex of a graph. Raises `GraphError` for more than MOST_TRIANGLES triangles."""
    if (count := clique_counts(graph.edges, graph.vertex_count)[2]) > MOST_TRIANGLES:
        raise GraphError(f"its complex has {count} triangles, more than {MOST_TRIANGLES}")
    return flag_complex(graph.edges, graph.vertex_count)


@dataclass(frozen=True)
class OneForm:
    """ω (N, 6) = log(T_i Z_ij T_j⁻¹), rotation first, on the N edges i < j of a complex, and the edges' weights (N,).

    Parallel measurements are pooled; the world's origin is the centroid of each component.
    """

    values: Floats
    weights: Floats


def one_form(graph: ViewGraph, world_from_cam: Floats, component: Ints | None = None) -> OneForm:
    """ω of a graph's edges at poses (V, 4, 4) (Section 3.3); `component (V,)`: by default the graph's own."""
    if component is None:
        component = connected_components(graph.edges, graph.vertex_count)
    centred = shifted(world_from_cam, -centroids(world_from_cam, component))
    omega = residual_form(graph.edges, graph.i_from_j, centred)
    return OneForm(*orient_edges(graph.edges, graph.vertex_count).pooled(omega, np.ones(graph.edge_count)))


def decompose(complex_: SimplicialComplex, omega: OneForm) -> HodgeDecomposition:
    """The Helmholtz–Hodge decomposition of ω on a complex (Theorem 4, Eq. (6))."""
    return hodge_decomposition(complex_.coboundary(0), complex_.coboundary(1), omega.values, omega.weights)
