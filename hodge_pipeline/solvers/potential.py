"""What the Poisson solvers share: f of a 1-form, the poses moved by it, what is left of the edges' disagreement."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from scipy.sparse import csr_matrix

from hodge_pipeline import se3
from hodge_pipeline.complex.coboundary import grounded_laplacian
from hodge_pipeline.complex.one_form import Logarithm
from hodge_pipeline.solvers.linear import factorise
from hodge_pipeline.solvers.problem import pinned_vertices
from hodge_pipeline.types import Floats, Ints


def poisson(d0: csr_matrix, weights: Floats, component: Ints, fixed: Ints) -> Callable[[Floats], Floats]:
    """From ω (edges of d0, 6) to f (V, 6), `d0ᵀ W d0 f = d0ᵀ W ω` (Eq. (7)).

    f is 0 at the fixed vertices (rows), and of mean zero on each component (V,) that has none.
    The Laplacian is factorised once; six right-hand sides are solved at a time.
    """
    gauge = pinned_vertices(component, fixed)
    factor = factorise(grounded_laplacian(d0, weights, gauge))
    count = np.bincount(component)[:, None].astype(float)
    count[component[fixed]] = np.inf

    def solve(omega: Floats) -> Floats:
        divergence = d0.T @ (weights[:, None] * omega)
        f = np.zeros_like(divergence)
        f[~gauge] = factor.solve(divergence[~gauge])
        sums = np.stack([np.bincount(component, column) for column in f.T], axis=1)
        return np.asarray(f - (sums / count)[component])

    return solve


def moved(poses: Floats, correction: Floats, start: Floats, component: Ints, fixed: Ints, log: Logarithm) -> Floats:
    """`exp(f_k) T_k` (V, 4, 4), then each component without a fixed vertex as one body, so that its first vertex is at
    its start exactly, as the fixed vertices (rows) are.
    """
    motion = se3.pairing_exp(correction) if log == "pairing" else se3.exp(correction)
    out = motion @ poses
    _, first = np.unique(component, return_index=True)
    body = np.asarray(start[first] @ se3.inverse(out[first]))
    body[component[fixed]] = np.eye(4)
    out = np.asarray(body[component] @ out)
    gauge = pinned_vertices(component, fixed)
    out[gauge] = start[gauge]
    return out


def residuals(edges: Ints, i_from_j: Floats, poses: Floats) -> tuple[Floats, Floats]:
    """Translation (E,) in metres and angle (E,) in radians of each edge's disagreement with the poses.

    The translation is the RMS of those that the two cameras see, so it does not depend on the edge's direction.
    """
    i, j = edges.T
    poses_say = se3.inverse(poses[i]) @ poses[j]
    j_from_i = se3.inverse(i_from_j)
    at_i, at_j = poses_say @ j_from_i, j_from_i @ poses_say
    translation = np.sqrt(((at_i[:, :3, 3] ** 2).sum(axis=1) + (at_j[:, :3, 3] ** 2).sum(axis=1)) / 2)
    return translation, np.linalg.norm(se3.so3_log(at_j[:, :3, :3]), axis=1)


def residual_metrics(edges: Ints, i_from_j: Floats, poses: Floats) -> Mapping[str, float]:
    """Mean and median disagreement of the edges, of which there is at least one, with the poses; metres and radians."""
    translation, angle = residuals(edges, i_from_j, poses)
    return {
        "translation_residual_mean_m": float(translation.mean()),
        "translation_residual_median_m": float(np.median(translation)),
        "rotation_residual_mean_rad": float(angle.mean()),
        "rotation_residual_median_rad": float(np.median(angle)),
    }
