"""The quotient of a graph by clusters of poses, each one rigid body: drift is pulled straight at a cost that hardly
grows with the graph.

Drift builds up over long ways, so that a few neighbours which agree keep their places among each other while it is
taken away: some thousand unknown motions stand for all poses.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra

from hodge_pipeline import se3
from hodge_pipeline.complex.components import connected_components, first_of_component
from hodge_pipeline.diagnosis.noise import Noise
from hodge_pipeline.types import Bools, Floats, Ints, ViewGraph

CLUSTERS = 6000
"""At most, in a graph that holds together: where there are no more poses than this, each is one."""
ACROSS = 2 / 3
"""Of the squared lever: the share at right angles to it, along which an error of rotation swings, of a mean axis."""


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
