"""The surface that the paper solves on: Algorithm 1, its triangulation, its weights, and what can be said of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.sparse import csr_matrix

from hodge_paper.cotangent import cotangent_weights
from hodge_paper.embedding import Embedding, Surface, embed, triangulate
from hodge_paper.homology import homology_generators, motion_deviation
from hodge_paper.rotation import angular_rotation, random_rotation
from hodge_paper.shortest_paths import surface_form
from hodge_pipeline.complex.coboundary import coboundary_0
from hodge_pipeline.complex.cycles import Loops, loop_products
from hodge_pipeline.complex.decomposition import HodgeDecomposition, gradient_fit
from hodge_pipeline.complex.series import series_classes
from hodge_pipeline.types import Floats, Ints

RotationSystem = Literal["random", "angular"]
MOST_CHECKED_EDGES = 20_000
"""Above it the figures that no pose depends on (energy shares, homology loops, bridges) are left out, and it is said:
they would take longer than the solve."""


@dataclass(frozen=True)
class PaperSurface:
    """A viewing graph embedded in closed surfaces, one for each component, and triangulated.

    `d0 (E + D, V)` and `weights (E + D,)`, the cotangent weights of unit edges, are those of the surface.
    """

    embedding: Embedding
    surface: Surface
    d0: csr_matrix
    weights: Floats

    def form(self, omega: Floats) -> Floats:
        """ω (E + D, 6) on all edges of the surface, from ω (E, 6) on the graph's (Algorithm 2)."""
        return surface_form(self.surface, omega)

    @property
    def is_checked(self) -> bool:
        """Whether the figures that no pose depends on are affordable."""
        return len(self.embedding.edges) <= MOST_CHECKED_EDGES

    def sizes(self) -> Mapping[str, float]:
        """Cells and genus of all components together, the longest cell, and how many diagonals cut the cells."""
        lengths = self.embedding.cells.lengths
        return {
            "cells": float(len(lengths)),
            "genus": float(self.embedding.genus),
            "longest_cell": float(lengths.max(initial=0)),
            "diagonals": float(len(self.surface.edges) - self.surface.graph_edge_count),
        }

    def shares(self, omega_on_surface: Floats) -> Mapping[str, float]:
        """The share of each Hodge part in the energy of ω, rotation and translation apart (Theorem 4)."""
        parts = surface_decomposition(self.d0, self.surface.d1, omega_on_surface, self.weights).energies().shares
        named = {}
        for name, (rotation, translation) in parts.items():
            named[f"share_{name}_rotation"], named[f"share_{name}_translation"] = rotation, translation
        return named

    def generators(self) -> Loops:
        """The 2g loops that generate the surface's homology (paper, Section 5)."""
        return homology_generators(self.embedding)

    def connectivity_notes(self) -> tuple[str, ...]:
        """What the graph lacks to be 3-connected, as Algorithm 1 asks: edges without which, one or two, it falls apart.

        Vertices without which it does are not looked for.
        """
        edges, count = self.embedding.edges, self.embedding.vertex_count
        series = series_classes(edges, count)
        bridges, chains = int((series < 0).sum()), int((np.bincount(series[series >= 0]) > 1).sum())
        least = int(np.bincount(edges.ravel(), minlength=count).min())
        if not bridges and not chains and least > 2:
            return ()
        return (
            f"the graph is not 3-connected, as Algorithm 1 asks: {bridges} bridges, {chains} groups of edges in "
            f"series, least degree {least}; it is embedded all the same",
        )


def surface_decomposition(d0: csr_matrix, d1: csr_matrix, omega: Floats, weights: Floats) -> HodgeDecomposition:
    """`hodge_decomposition` of a closed surface, whose co-exact part costs a factorisation too: on the dual graph
    W⁻¹ d1ᵀ g is a gradient again, fitted to W (ω − d0 f) in the weights 1 / w.
    """
    exact = np.asarray(d0 @ gradient_fit(d0, omega, weights))
    rest, dual = omega - exact, csr_matrix(d1.T, dtype=float)
    coexact = np.asarray(dual @ gradient_fit(dual, weights[:, None] * rest, 1.0 / weights)) / weights[:, None]
    return HodgeDecomposition(exact, coexact, rest - coexact, weights)


def make_surface(edges: Ints, world_from_cam: Floats, rotation: RotationSystem, seed: int) -> PaperSurface:
    """The surface of a graph: Algorithm 1 with random orders (seeded), or by the angle of the neighbours' positions."""
    vertex_count = len(world_from_cam)
    if rotation == "random":
        orders = random_rotation(edges, seed)
    else:
        orders = angular_rotation(edges, np.asarray(world_from_cam[:, :3, 3]))
    embedding = embed(edges, vertex_count, orders)
    surface = triangulate(embedding)
    d0 = coboundary_0(surface.edges, vertex_count)
    return PaperSurface(embedding, surface, d0, cotangent_weights(surface))


def homology_metrics(generators: Loops | None, i_from_j: Floats, name: str) -> Mapping[str, float]:
    """The mean ‖t‖ in metres and mean ‖R − I‖_F of the motions around the generators (paper, Section 5), if any."""
    if generators is None or not len(generators):
        return {}
    translation, rotation = motion_deviation(loop_products(generators, i_from_j))
    return {
        f"{name}_translation_mean_m": float(translation.mean()),
        f"{name}_rotation_mean": float(rotation.mean()),
    }
