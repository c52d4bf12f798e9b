"""How loosely the poses at an edge's two ends hang together without it: the effective resistance of the others."""

from __future__ import annotations

import numpy as np

from hodge_pipeline.complex.coboundary import coboundary_0, grounded_laplacian
from hodge_pipeline.complex.components import connected_components, first_of_component
from hodge_pipeline.solvers.linear import factorise
from hodge_pipeline.types import Bools, Floats, Ints

EXACT_TO = 1500
SKETCHES = 24
BRIDGE = 1e-3


def effective_resistance(edges: Ints, vertex_count: int, used: Bools) -> Floats:
    """The resistance (E,) between the ends of each edge through the used edges other than itself, each of resistance
    one: the variance of the relative pose in units of an edge's. ∞ where they do not join the ends.

    Exact up to 1500 vertices, beyond that by random projections (Spielman and Srivastava 2008), within a third or so.
    """
    rows = np.flatnonzero(used & (edges[:, 0] != edges[:, 1]))
    component = connected_components(edges[rows], vertex_count)
    grounded = first_of_component(component)
    d0 = coboundary_0(edges[rows], vertex_count)
    factor = factorise(grounded_laplacian(d0, np.ones(len(rows)), grounded))
    through = (
        _exact(factor.solve, grounded, edges)
        if vertex_count <= EXACT_TO
        else _sketched(factor.solve, d0, grounded, edges)
    )
    joined = component[edges[:, 0]] == component[edges[:, 1]]
    own = np.zeros(len(edges), bool)
    own[rows] = True
    rest = np.maximum(1 - through, 0.0)
    without = np.where(rest > BRIDGE, through / np.where(rest > BRIDGE, rest, 1.0), np.inf)
    return np.where(joined, np.where(own, without, through), np.inf)


def _exact(solve, grounded: Bools, edges: Ints) -> Floats:  # type: ignore[no-untyped-def]
    count = len(grounded)
    inverse = np.zeros((count, count))
    free = np.flatnonzero(~grounded)
    inverse[np.ix_(free, free)] = solve(np.eye(len(free)))
    i, j = edges.T
    return np.asarray(inverse[i, i] + inverse[j, j] - 2 * inverse[i, j])


def _sketched(solve, d0, grounded: Bools, edges: Ints) -> Floats:  # type: ignore[no-untyped-def]
    rng = np.random.default_rng(0)
    signs = rng.choice([-1.0, 1.0], size=(d0.shape[0], SKETCHES)) / np.sqrt(SKETCHES)
    sketch = np.zeros((d0.shape[1], SKETCHES))
    sketch[~grounded] = solve(np.asarray(d0.T @ signs)[~grounded])
    return np.asarray(((sketch[edges[:, 0]] - sketch[edges[:, 1]]) ** 2).sum(axis=1))
