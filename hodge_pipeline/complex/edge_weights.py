"""One positive weight for each edge: the diagonal of W in the scalar Laplacian d0ᵀ W d0."""

from __future__ import annotations

from typing import Literal

import numpy as np

from hodge_pipeline.types import Floats, ViewGraph

EdgeWeighting = Literal["unit", "information"]
SMALLEST_SHARE = 1e-3
"""Of an edge's largest eigenvalue: below it, a standard deviation 30 times as large, a direction is not measured."""


def edge_weights(graph: ViewGraph, kind: EdgeWeighting, lever_arm_m: float) -> tuple[Floats, tuple[str, ...]]:
    """The weight (E,) of each edge, 0 for one to be ignored, and notes on what had to be replaced."""
    if kind == "information":
        return _information(graph, lever_arm_m)
    return np.ones(graph.edge_count), ()


def _information(graph: ViewGraph, lever_arm_m: float) -> tuple[Floats, tuple[str, ...]]:
    """6 / tr(S Ω⁻¹ S), S = diag(ℓ, ℓ, ℓ, 1, 1, 1): the inverse of the mean variance, in m², with rotations as the
    displacement that they cause at the lever arm ℓ. Eigenvalues of S⁻¹ Ω S⁻¹ are clipped: a direction that nothing
    measured makes an edge light, but does not cut it.
    """
    scale = np.array([lever_arm_m] * 3 + [1.0] * 3)
    scaled = graph.information / (scale[:, None] * scale)
    eigenvalues = np.linalg.eigvalsh((scaled + np.swapaxes(scaled, -1, -2)) / 2)
    largest = eigenvalues[:, -1:]
    clipped = np.maximum(eigenvalues, SMALLEST_SHARE * largest)
    measured = largest[:, 0] > 0
    weight = np.where(measured, 6.0 / (1.0 / np.where(measured[:, None], clipped, 1.0)).sum(axis=1), 0.0)
    open_edges = int((measured & (eigenvalues[:, 0] < SMALLEST_SHARE * largest[:, 0])).sum())
    if not open_edges:
        return weight, ()
    return weight, (
        f"{open_edges} edges hardly measure some direction: its eigenvalue is clipped, and they weigh little",
    )
