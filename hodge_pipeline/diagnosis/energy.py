"""How much of what the edges leave over is gradient, curl of triangles, or loops that no triangle fills."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.complex.cech import clique_counts, flag_complex, orient_edges
from hodge_pipeline.complex.coboundary import coboundary_0
from hodge_pipeline.complex.decomposition import hodge_decomposition
from hodge_pipeline.errors import GraphError
from hodge_pipeline.types import Bools, Floats, Ints, ViewGraph

MOST_TRIANGLES, MOST_EDGES = 200_000, 50_000
CAVEATS = (
    "energy shares are of ω = log(T_i Z_ij T_j⁻¹) at the robust poses, unit weights, world origin at the centroid of "
    "each piece; where residual motions are large ω is only their linearisation, and wrong edges dominate it",
)


def energy_shares(
    graph: ViewGraph, world_from_cam: Floats, piece: Ints, kept: Bools
) -> tuple[Mapping[str, Mapping[str, tuple[float, float]]], tuple[str, ...]]:
    """(rotation, translation) shares of each part, for all edges inside pieces (`before`) and the kept (`after`)."""
    if graph.edge_count > MOST_EDGES:
        return {}, (f"energy shares left out: more than {MOST_EDGES} edges",)
    inside = piece[graph.edges[:, 0]] == piece[graph.edges[:, 1]]
    inside &= graph.edges[:, 0] != graph.edges[:, 1]
    centred = _centred(world_from_cam, piece)
    shares: dict[str, Mapping[str, tuple[float, float]]] = {}
    for name, rows in (("before", inside), ("after", inside & kept)):
        chosen = graph.select(np.flatnonzero(rows))
        if not chosen.edge_count:
            continue
        if clique_counts(chosen.edges, graph.vertex_count)[2] > MOST_TRIANGLES:
            return {}, (f"energy shares left out: more than {MOST_TRIANGLES} triangles",)
        try:
            shares[name] = _shares(chosen, centred)
        except GraphError as error:
            return {}, (f"energy shares left out: {error}",)
    return shares, CAVEATS


def _shares(graph: ViewGraph, world_from_cam: Floats) -> Mapping[str, tuple[float, float]]:
    i, j = graph.edges.T
    omega = se3.log(world_from_cam[i] @ graph.i_from_j @ se3.inverse(world_from_cam[j]))
    form, weights = orient_edges(graph.edges, graph.vertex_count).pooled(omega, np.ones(graph.edge_count))
    complex_ = flag_complex(graph.edges, graph.vertex_count)
    d0 = coboundary_0(complex_.simplices[1], graph.vertex_count)
    shares: Mapping[str, tuple[float, float]] = hodge_decomposition(d0, complex_.coboundary(1), form, weights).shares()
    return shares


def _centred(world_from_cam: Floats, piece: Ints) -> Floats:
    sizes = np.bincount(piece)
    means = np.stack([np.bincount(piece, world_from_cam[:, axis, 3]) for axis in range(3)], axis=1) / sizes[:, None]
    centred: Floats = np.array(world_from_cam)
    centred[:, :3, 3] -= means[piece]
    return centred
