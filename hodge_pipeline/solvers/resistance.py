"""Effective resistance between the ends of an edge without that edge: the variance of their relative pose."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.sparse import csr_matrix

from hodge_pipeline.complex.coboundary import coboundary_0, grounded_laplacian
from hodge_pipeline.complex.components import connected_components, first_of_component
from hodge_pipeline.complex.series import series_classes
from hodge_pipeline.solvers.linear import Factor, factorise
from hodge_pipeline.types import Bools, Floats, Ints

EXACT_TO, SKETCHES = 1500, 24
"""Vertices up to which resistances are exact, and projections beyond: limits on cost."""


@dataclass(frozen=True)
class Network:
    """Edges as unit resistors, and the effective resistance between any two vertices.

    `component (V,)`; `grounded (V,)` one vertex of each; `d0` of the edges.
    """

    component: Ints
    grounded: Bools
    d0: csr_matrix

    @classmethod
    def of(cls, edges: Ints, vertex_count: int) -> Network:
        """The network of these edges; self-loops are left out."""
        proper = edges[edges[:, 0] != edges[:, 1]]
        component = connected_components(proper, vertex_count)
        return cls(component, first_of_component(component), coboundary_0(proper, vertex_count))

    @cached_property
    def factor(self) -> Factor:
        """The factor of the Laplacian without the grounded vertices."""
        return factorise(grounded_laplacian(self.d0, np.ones(self.d0.shape[0]), self.grounded))

    @property
    def is_exact(self) -> bool:
        """Whether resistances are more than estimates."""
        return len(self.grounded) <= EXACT_TO

    def between(self, pairs: Ints) -> Floats:
        """The resistance (P,) of each pair: the variance of its relative pose in units of an edge's. ∞ where no path
        joins the two.

        Exact up to 1500 vertices, beyond that by random projections (Spielman and Srivastava 2008), within a third or
        so.
        """
        i, j = pairs.T
        through = self._exact(i, j) if self.is_exact else self._sketched(i, j)
        return np.where(self.component[i] == self.component[j], through, np.inf)

    def potentials(self, i: int, j: int) -> Floats:
        """The potential (V,) of each vertex for a unit current from j to i."""
        current = np.zeros((len(self.grounded), 1))
        current[i], current[j] = 1, -1
        out = np.zeros(len(self.grounded))
        out[~self.grounded] = self.factor.solve(current[~self.grounded])[:, 0]
        return out

    def _exact(self, i: Ints, j: Ints) -> Floats:
        inverse = np.zeros((len(self.grounded), len(self.grounded)))
        free = np.flatnonzero(~self.grounded)
        inverse[np.ix_(free, free)] = self.factor.solve(np.eye(len(free)))
        return np.asarray(inverse[i, i] + inverse[j, j] - 2 * inverse[i, j])

    def _sketched(self, i: Ints, j: Ints) -> Floats:
        signs = np.random.default_rng(0).choice([-1.0, 1.0], size=(self.d0.shape[0], SKETCHES)) / np.sqrt(SKETCHES)
        sketch = np.zeros((self.d0.shape[1], SKETCHES))
        sketch[~self.grounded] = self.factor.solve(np.asarray(self.d0.T @ signs)[~self.grounded])
        return np.asarray(((sketch[i] - sketch[j]) ** 2).sum(axis=1))


def effective_resistance(edges: Ints, used: Bools, network: Network) -> Floats:
    """The resistance (E,) between the ends of each edge through the other used edges: ∞ for bridges, and where no used
    edges join the ends. `network`: of the used edges. Estimated resistances are bounded by their error.
    """
    own = np.flatnonzero(used & (edges[:, 0] != edges[:, 1]))
    out = network.between(edges)
    rest = np.maximum(1 - out[own], np.finfo(float).eps if network.is_exact else np.sqrt(2 / SKETCHES))
    bridge = series_classes(edges[own], len(network.component)) < 0
    out[own] = np.where(bridge, np.inf, out[own] / rest)
    return out
