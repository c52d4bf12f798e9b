"""The Hodge decomposition of a 1-form: exact, co-exact and harmonic parts (Theorem 4, Eq. (6))."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_matrix, diags
from scipy.sparse.linalg import splu

from hodge_pipeline.complex.coboundary import grounded_laplacian
from hodge_pipeline.complex.components import connected_components, first_of_component
from hodge_pipeline.complex.energies import Energies
from hodge_pipeline.errors import GraphError
from hodge_pipeline.types import Floats, Ints

RELATIVE_RESIDUAL, ENOUGH = 1e-13, 1e-9
"""Gradient norms, relative to that of ω without its exact part: one ends conjugate gradients, one they must reach."""


@dataclass(frozen=True)
class HodgeDecomposition:
    """`ω = exact + coexact + harmonic`, each (E, k), orthogonal in the inner product of `weights (E,)`."""

    exact: Floats
    coexact: Floats
    harmonic: Floats
    weights: Floats

    def energies(self, simplices: tuple[int, ...] = ()) -> Energies:
        """The energy of each part, on a complex of so many simplices.

        Columns 0-2 are the rotation, the rest the translation. Depends on the world's origin: form ω around the
        centroid (see `centroids`).
        """
        columns = [self.weights @ part**2 for part in (self.exact, self.coexact, self.harmonic)]
        return Energies(simplices, *((float(part[:3].sum()), float(part[3:].sum())) for part in columns))


def hodge_decomposition(d0: csr_matrix, d1: csr_matrix, omega: Floats, weights: Floats) -> HodgeDecomposition:
    """`ω = d0 f + W⁻¹ d1ᵀ g + h` (Eq. (6)) of ω (E, k), for d0 (E, V), d1 (T, E) and positive weights (E,).

    The exact part costs one sparse factorisation for all columns and components; the co-exact part is found by
    conjugate gradients. Raises `GraphError` for weights that are not positive, or where they do not converge.
    """
    weights = np.asarray(weights, float)
    if not (np.isfinite(weights) & (weights > 0)).all():
        bad = int((~(np.isfinite(weights) & (weights > 0))).sum())
        raise GraphError(f"the Hodge decomposition needs positive weights: {bad} of {len(weights)} are not")
    omega = np.asarray(omega, float)
    exact = np.asarray(d0 @ gradient_fit(d0, omega, weights))
    rest = omega - exact
    dual = csr_matrix(d1.T, dtype=float)
    coexact = np.asarray(dual @ _conjugate_gradients(dual, rest, weights)) / weights[:, None]
    return HodgeDecomposition(exact, coexact, rest - coexact, weights)


def gradient_fit(d: csr_matrix, values: Floats, weights: Floats) -> Floats:
    """The potential (V, k), 0 at the first vertex of each component, whose gradient `d f` is nearest to the values
    (E, k) in the weights (E,): `dᵀ W d f = dᵀ W values` (Eq. (7)).
    """
    component = connected_components(_ends(d), d.shape[1])
    grounded = first_of_component(component)
    out = np.zeros((d.shape[1], values.shape[1]))
    if grounded.all():
        return out
    laplacian = grounded_laplacian(d, weights, grounded)
    factor = splu(laplacian, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    out[~grounded] = factor.solve(np.asarray(d.T @ (weights[:, None] * values))[~grounded])
    return out


def _ends(d: csr_matrix) -> Ints:
    """The two columns of each row that is not empty."""
    d = csr_matrix(d)
    d.eliminate_zeros()
    return np.asarray(d.indices.reshape(-1, 2), np.int64)


def _conjugate_gradients(dual: csr_matrix, rest: Floats, weights: Floats) -> Floats:
    """The g (T, k) that minimises ‖W^{1/2}(rest − W⁻¹ d1ᵀ g)‖: normal equations, all columns in one product."""
    square_root = np.sqrt(weights)[:, None]
    matrix = csr_matrix(diags(1 / square_root[:, 0]) @ dual)
    norms = np.sqrt(np.asarray(matrix.multiply(matrix).sum(axis=0))).ravel()
    matrix = csr_matrix(matrix @ diags(1 / np.where(norms > 0, norms, 1.0)))
    transposed = csr_matrix(matrix.T)
    residual = square_root * rest
    scale = np.maximum(np.linalg.norm(residual, axis=0), np.finfo(float).tiny)
    solution = np.zeros((matrix.shape[1], rest.shape[1]))
    gradient = transposed @ residual
    direction, energy = gradient.copy(), (gradient**2).sum(axis=0)
    for _ in range(20 * matrix.shape[0] + 100):
        if (np.sqrt(energy) <= RELATIVE_RESIDUAL * scale).all():
            break
        image = matrix @ direction
        step = energy / np.maximum((image**2).sum(axis=0), np.finfo(float).tiny)
        solution += step * direction
        residual -= step * image
        gradient = transposed @ residual
        previous, energy = energy, (gradient**2).sum(axis=0)
        direction = gradient + energy / np.maximum(previous, np.finfo(float).tiny) * direction
    if not (np.sqrt(energy) <= ENOUGH * scale).all():
        raise GraphError("the co-exact part did not converge: the weights differ by too many orders of magnitude")
    return np.asarray(solution / np.where(norms > 0, norms, 1.0)[:, None])
