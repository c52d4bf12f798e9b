"""Algorithm 1: a graph embedded in an oriented closed surface by a cyclic order of the edges around each vertex."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components as csgraph_components

from hodge_paper.rotation import check_rotation, dart_sources
from hodge_pipeline.complex.coboundary import check_edges
from hodge_pipeline.complex.components import connected_components
from hodge_pipeline.complex.cycles import Loops
from hodge_pipeline.types import Ints


@dataclass(frozen=True)
class Embedding:
    """The cells that half-edges (darts) trace: dart 2e runs along edge e, dart 2e + 1 against it.

    - `cells`: the closed walks of edges around the cells, each starting at its lowest dart.
    - `cell_of_dart (2E,)`: the one cell that each half-edge bounds.
    - `component (V,)`: see `connected_components`.
    """

    vertex_count: int
    edges: Ints
    cells: Loops
    cell_of_dart: Ints
    component: Ints

    @property
    def euler_characteristics(self) -> Ints:
        """V − E + F (C,) of each component; an isolated vertex lies on a sphere: one cell by convention."""
        pieces = int(self.component.max(initial=-1)) + 1
        vertices = np.bincount(self.component, minlength=pieces)
        edges = np.bincount(self.component[self.edges[:, 0]], minlength=pieces)
        first_edge = self.cells.edge[self.cells.offsets[:-1]]
        cells = np.bincount(self.component[self.edges[first_edge, 0]], minlength=pieces) + (edges == 0)
        return np.asarray(vertices - edges + cells, np.int64)

    @property
    def genera(self) -> Ints:
        """The genus (C,) of each component's surface, from V − E + F = 2 − 2g."""
        return (2 - self.euler_characteristics) // 2

    @property
    def genus(self) -> int:
        """The handles of all components together; 2 × genus loops generate the homology."""
        return int(self.genera.sum())


@dataclass(frozen=True)
class Surface:
    """A triangulated embedding, as a Δ-complex: edges are known by id, since two of them may join the same vertices.

    - `edges (E + D, 2)`: the graph's edges, then the diagonals.
    - `faces`: closed walks of three edges; digons and monogons of the embedding stay as they are.
    """

    vertex_count: int
    edges: Ints
    graph_edge_count: int
    faces: Loops

    @property
    def d1(self) -> csr_matrix:
        """d1 (F, E + D) of Eq. (1) on the surface: the sum of ω around each face."""
        return self.faces.incidence(len(self.edges))


def embed(edges: Ints, vertex_count: int, rotation: Ints) -> Embedding:
    """The embedding of a graph that a rotation system (2E,) defines: `h_k⁺` is followed by `h_{k+1}⁻` (Algorithm 1).

    Self-loops, parallel edges, several components and isolated vertices are legal. Linear in the edges but for the
    logarithm of the longest cell.
    """
    edges = np.asarray(edges, np.int64).reshape(-1, 2)
    check_edges(edges, vertex_count)
    rotation = check_rotation(edges, rotation)
    after = _next_around_vertex(edges, rotation)
    # a half-edge that arrives at v is followed by the one that leaves v next after its own reverse
    following = after[np.arange(len(after)) ^ 1]
    cell, place = _orbits(following)
    order = np.lexsort((place, cell))
    offsets = np.concatenate([[0], np.cumsum(np.bincount(cell))]).astype(np.int64)
    cells = Loops(offsets, order // 2, 1 - 2 * (order % 2))
    return Embedding(vertex_count, edges, cells, cell, connected_components(edges, vertex_count))


def _next_around_vertex(edges: Ints, rotation: Ints) -> Ints:
    source = dart_sources(edges)[rotation]
    starts = np.flatnonzero(np.diff(source, prepend=-1))
    ends = np.append(starts[1:], len(source)) - 1 if len(starts) else starts
    following = np.arange(1, len(source) + 1)
    following[ends] = starts
    after = np.empty(len(source), np.int64)
    after[rotation] = rotation[following]
    return after


def _orbits(following: Ints) -> tuple[Ints, Ints]:
    """The orbit of each element of a permutation, numbered by lowest element, and its place in it from there."""
    count = len(following)
    if count == 0:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    graph = csr_matrix((np.ones(count, np.int8), following, np.arange(count + 1)), shape=(count, count))
    _, label = csgraph_components(graph, directed=False)
    _, leader, orbit = np.unique(label, return_index=True, return_inverse=True)
    rank = np.empty(len(leader), np.int64)
    rank[np.argsort(leader)] = np.arange(len(leader))
    # list ranking: each round doubles the stride towards the element before the leader
    is_leader = np.zeros(count, bool)
    is_leader[leader] = True
    stride = np.where(is_leader[following], -1, following)
    to_end = (stride >= 0).astype(np.int64)
    active = np.flatnonzero(stride >= 0)
    while len(active):
        to_end[active] += to_end[stride[active]]
        stride[active] = stride[stride[active]]
        active = active[stride[active] >= 0]
    orbit = rank[orbit.ravel()]
    return orbit, to_end[leader[np.argsort(leader)]][orbit] - to_end


def triangulate(embedding: Embedding) -> Surface:
    """Every cell of n > 3 sides cut by n − 3 diagonals from its first corner; smaller cells stay as they are."""
    cells, graph_edges = embedding.cells, len(embedding.edges)
    lengths = cells.lengths
    start_vertex = _start_vertices(embedding)
    apex, third = _diagonal_ends(cells)
    diagonals = np.stack([start_vertex[apex], start_vertex[third]], axis=1)
    before = np.concatenate([[0], np.cumsum(np.maximum(lengths - 3, 0))])
    small, large = np.flatnonzero(lengths < 3), np.flatnonzero(lengths >= 3)
    triangles = lengths[large] - 2
    cell = np.repeat(large, triangles)
    k = np.arange(len(cell)) - np.repeat(np.cumsum(triangles) - triangles, triangles) + 1
    first, size = cells.offsets[:-1][cell], lengths[cell]
    # triangle k of a cell: apex → corner k → corner k + 1 → apex; the outermost two sides are the cell's own
    diagonal_to = graph_edges + before[cell] + k - 2
    edge = np.stack(
        [
            np.where(k == 1, cells.edge[first], diagonal_to),
            cells.edge[first + k],
            np.where(k == size - 2, cells.edge[first + size - 1], diagonal_to + 1),
        ],
        axis=1,
    )
    sign = np.stack(
        [
            np.where(k == 1, cells.sign[first], 1),
            cells.sign[first + k],
            np.where(k == size - 2, cells.sign[first + size - 1], -1),
        ],
        axis=1,
    )
    rest = cells.select(small)
    face_lengths = np.concatenate([np.full(len(edge), 3, np.int64), rest.lengths])
    faces = Loops(
        np.concatenate([[0], np.cumsum(face_lengths)]).astype(np.int64),
        np.concatenate([edge.ravel(), rest.edge]),
        np.concatenate([sign.ravel(), rest.sign]),
    )
    return Surface(embedding.vertex_count, np.vstack([embedding.edges, diagonals]), graph_edges, faces)


def _start_vertices(embedding: Embedding) -> Ints:
    """The vertex at which each step (2E,) of the cells' outlines begins."""
    cells = embedding.cells
    return np.asarray(embedding.edges[cells.edge, np.where(cells.sign > 0, 0, 1)], np.int64)


def _diagonal_ends(cells: Loops) -> tuple[Ints, Ints]:
    """For each diagonal, the outline steps that begin at its two ends: its cell's first step, and a later one."""
    count = np.maximum(cells.lengths - 3, 0)
    cell = np.repeat(np.arange(len(cells)), count)
    k = np.arange(len(cell)) - np.repeat(np.cumsum(count) - count, count) + 2
    first = cells.offsets[:-1][cell]
    return first, first + k
