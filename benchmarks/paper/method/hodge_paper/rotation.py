"""Rotation systems: at each vertex, the cyclic order of the edge ends around it (Algorithm 1, first loop).

A dart is an edge end: dart 2e leaves the first vertex of edge e, dart 2e + 1 its second. A rotation system is the
array of all darts (2E,), sorted by the vertex that they leave, in cyclic order within it.
"""

from __future__ import annotations

import numpy as np

from hodge_pipeline.complex.cycles import spanning_forest
from hodge_pipeline.errors import GraphError
from hodge_pipeline.types import Floats, Ints


def dart_sources(edges: Ints) -> Ints:
    """The vertex (2E,) that each dart leaves."""
    return np.asarray(edges, np.int64).reshape(-1)


def random_rotation(edges: Ints, seed: int) -> Ints:
    """The paper's choice: a random cyclic order at each vertex, the same for the same seed."""
    source = dart_sources(edges)
    return np.asarray(np.lexsort((np.random.default_rng(seed).random(len(source)), source)), np.int64)


def angular_rotation(edges: Ints, positions: Floats) -> Ints:
    """The order of the neighbours by their angle in the vertex's principal plane; `positions (V, 3)` of the vertices.

    The planes' normals are turned to agree along a spanning tree, so that neighbours turn the same way: cells are then
    small and the genus is low wherever the cameras lie near a surface.
    """
    source = dart_sources(edges)
    target = source.reshape(-1, 2)[:, ::-1].reshape(-1)
    offset = positions[target] - positions[source]
    length = np.linalg.norm(offset, axis=1, keepdims=True)
    direction = offset / np.where(length > 0, length, 1.0)
    first, second = _principal_axes(edges, source, direction, len(positions))
    along = np.einsum("nk,nk->n", direction, first[source])
    across = np.einsum("nk,nk->n", direction, second[source])
    return np.asarray(np.lexsort((np.arctan2(across, along), source)), np.int64)


def _principal_axes(edges: Ints, source: Ints, direction: Floats, count: int) -> tuple[Floats, Floats]:
    moments = np.zeros((count, 3, 3))
    for a in range(3):
        for b in range(3):
            moments[:, a, b] = np.bincount(source, direction[:, a] * direction[:, b], minlength=count)
    _, axes = np.linalg.eigh(moments)
    normal, first = axes[:, :, 0], axes[:, :, 2]
    normal = normal * _agreeing_signs(edges, normal)[:, None]
    return first, np.cross(normal, first)


def _agreeing_signs(edges: Ints, normal: Floats) -> Floats:
    forest = spanning_forest(edges, len(normal))
    child = np.flatnonzero(forest.parent >= 0)
    sign = np.ones(len(normal))
    sign[child] = np.where(np.einsum("nk,nk->n", normal[child], normal[forest.parent[child]]) < 0, -1.0, 1.0)
    above, active = forest.parent.copy(), child
    while len(active):
        sign[active] *= sign[above[active]]
        above[active] = above[above[active]]
        active = active[above[active] >= 0]
    return sign


def check_rotation(edges: Ints, rotation: Ints) -> Ints:
    """The rotation system given, if it is one. Raises `GraphError` where a dart is missing or at another vertex."""
    source = dart_sources(edges)
    rotation = np.asarray(rotation).astype(np.int64)
    if not np.array_equal(np.sort(rotation), np.arange(len(source))):
        raise GraphError(f"a rotation system lists each of the {len(source)} edge ends (darts) exactly once")
    if (np.diff(source[rotation]) < 0).any():
        raise GraphError("a rotation system lists the edge ends of vertex 0 first, then those of vertex 1, …")
    return rotation
