"""One positive weight for each edge: the diagonal of W in the scalar Laplacian d0ᵀ W d0."""

from __future__ import annotations

from typing import Literal

import numpy as np

from hodge_pipeline.types import Floats, ViewGraph

EdgeWeighting = Literal["unit", "information"]


def edge_weights(graph: ViewGraph, kind: EdgeWeighting, lever_arm_m: float) -> tuple[Floats, tuple[str, ...]]:
    """The weight (E,) of each edge, 0 for one to be ignored, and notes on what had to be replaced."""
    if kind == "information":
        return _information(graph, lever_arm_m)
    return np.ones(graph.edge_count), ()


def _information(graph: ViewGraph, lever_arm_m: float) -> tuple[Floats, tuple[str, ...]]:
    """6 / tr(S Ω⁻¹ S), S = diag(ℓ, ℓ, ℓ, 1, 1, 1): the inverse of the mean variance, in m², with rotations as the
    displacement that they cause at the lever arm ℓ. Where Ω is not positive definite: tr(S⁻¹ Ω S⁻¹) / 6.
    """
    scale = np.array([lever_arm_m] * 3 + [1.0] * 3)
    scaled = graph.information / (scale[:, None] * scale)
    eigenvalues = np.linalg.eigvalsh((scaled + np.swapaxes(scaled, -1, -2)) / 2)
    definite = eigenvalues[:, 0] > 1e-12 * np.abs(eigenvalues[:, -1])
    harmonic = 6.0 / np.where(definite[:, None], 1.0 / np.where(definite[:, None], eigenvalues, 1.0), 1.0).sum(axis=1)
    weight = np.where(definite, harmonic, np.maximum(eigenvalues.mean(axis=1), 0.0))
    replaced = int((~definite & (weight > 0)).sum())
    if not replaced:
        return weight, ()
    return weight, (f"{replaced} edges with an information matrix that is not positive definite: its trace is used",)
