"""The χ² that judges an edge: ξᵀ Λ ξ with ξ = log(Z⁻¹ T_i⁻¹ T_j), the same for an edge written the other way round.

Reversal gives ξ' = −Ad(Z) ξ, and information moves with it: Λ' = Ad(Z)⁻ᵀ Λ Ad(Z)⁻¹. Where only a spread of rotation
and one of translation are known, they hold at both ends: Λ = ½ (Λ₀ + Ad(Z)ᵀ Λ₀ Ad(Z)).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.special import chdtri, fdtri

from hodge_pipeline import se3
from hodge_pipeline.types import Bools, Floats, Ints, ViewGraph

FREEDOM = 4.0
"""Degrees of freedom of Student's t, the tails of real registration errors: of nine graphs of fragments of rooms."""
REGISTERED_FREEDOM = 30.0
"""As `FREEDOM`, of edges that a run registered, accepted and kept: red kitchen, fr1/xyz, fr1/rpy, rendered rooms. 10 to
100 do as well; a gate makes fr1 worse, and 4 makes red kitchen's rotations from frame to frame worse.
"""
MEDIAN_CHI2 = {axes: float(chdtri(axes, 0.5)) for axes in (1, 3, 6)}
EXACT = 1e-9
"""Share of the largest χ² below which an edge fits exactly, being in no cycle, and is no sample of the usual χ²."""
UNMEASURED = 1e-9
"""Least eigenvalue of information scaled to a unit diagonal: where it is less, nothing was measured."""


def residual_twists(graph: ViewGraph, world_from_cam: Floats) -> Floats:
    """Residual twists ξ = log(Z⁻¹ T_i⁻¹ T_j) (E, 6) at poses (V, 4, 4): rotation, translation, in j's axes."""
    i, j = graph.edges.T
    return se3.log(se3.inverse(graph.i_from_j) @ se3.inverse(world_from_cam[i]) @ world_from_cam[j])


def chi2_by_information(graph: ViewGraph, world_from_cam: Floats) -> Floats:
    """χ² (E,) by the graph's own information, 6 on average where information and poses are right."""
    xi = residual_twists(graph, world_from_cam)
    return np.asarray(np.einsum("ea,eab,eb->e", xi, graph.information, xi))


def tail_weight(chi2: Floats | float, axes: int | Ints, freedom: float = FREEDOM) -> Floats:
    """The weight of Student's t for each χ² of `axes` dimensions: 1 at the expected χ², more below."""
    return np.asarray((freedom + axes) / (freedom + np.asarray(chi2)))


def tail_gate(axes: int, share: float) -> float:
    """The χ² that this share of right edges exceeds: a quantile of Fisher's F, since errors follow Student's t."""
    return axes * float(fdtri(axes, FREEDOM, 1 - share))


STUDENT_99 = {axes: tail_gate(axes, 0.01) for axes in (1, 2, 3, 6)}
"""The χ² gate of an edge, by its number of axes: the 99 % quantile under Student's t."""


def student_weight(chi2: Floats, axes: int, *, usual: Floats, registered: bool, needed: Bools | bool = False) -> Floats:
    """The weight (E,) of each χ² in a robust solve: that of Student's t, 1 up to the expected χ² and 0 beyond its 99 %
    quantile. The median of `usual (N,)` gives the χ² their scale. Edges that are `registered` and kept have lighter
    tails, and none weighs 0; nor does one that is `needed (E,)` to hold its ends together.
    """
    voting = usual[usual > EXACT * usual.max(initial=0.0)]
    scale = float(np.median(voting)) / MEDIAN_CHI2[axes] if len(voting) else 1.0
    scaled = chi2 / max(scale, np.finfo(float).tiny)
    freedom, gate = (REGISTERED_FREEDOM, np.inf) if registered else (FREEDOM, STUDENT_99[axes])
    return np.where(needed | (scaled <= gate), np.minimum(tail_weight(scaled, axes, freedom), 1.0), 0.0)


def squares_at_both_ends(i_from_j: Floats, xi: Floats) -> tuple[Floats, Floats]:
    """Squared residuals (E,) of twists (E, 6): rotation, rad², and translation, m², the mean of both ends."""
    turn, here = xi[:, :3], xi[:, 3:]
    there = here + np.cross(turn, se3.inverse(i_from_j)[:, :3, 3])  # at frame i's origin
    return (turn**2).sum(axis=1), ((here**2).sum(axis=1) + (there**2).sum(axis=1)) / 2


def in_vertex_order(graph: ViewGraph) -> tuple[ViewGraph, Bools]:
    """The graph with every edge from the lower vertex row to the higher, and which edges (E,) were turned round.

    Information moves with them, but for units that stand for unknown information.
    """
    turned = graph.edges[:, 0] > graph.edges[:, 1]
    if not turned.any():
        return graph, turned
    edges, motions, information = graph.edges.copy(), graph.i_from_j.copy(), graph.information
    edges[turned] = edges[turned, ::-1]
    motions[turned] = se3.inverse(motions[turned])
    if not has_unit_information(graph):
        information = information.copy()
        information[turned] = se3.pull_back(motions[turned], information[turned])
    return replace(graph, edges=edges, i_from_j=motions, information=information), turned


def has_unit_information(graph: ViewGraph) -> bool:
    """Whether all edges have the identity that files hold for unknown information, of angles or of half angles."""
    diagonal = graph.information[:, range(6), range(6)]
    units = np.isin(diagonal[:, :3], (0, 0.25, 1)).all() and np.isin(diagonal[:, 3:], (0, 1)).all()
    return bool(units and np.count_nonzero(graph.information) == np.count_nonzero(diagonal))


def mean_variances(graph: ViewGraph, planar: bool) -> tuple[Floats, Floats]:
    """The mean variances (E,) of an axis of rotation and of translation that the information states, the latter of both
    ends: an edge written the other way round has the same. A direction that nothing measured has a very large one.
    """
    axes = np.array([2, 3, 4]) if planar else np.arange(6)
    stated = graph.information[:, axes[:, None], axes]
    diagonal = np.einsum("eii->ei", stated)
    scale = 1 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    values, vectors = np.linalg.eigh(stated * scale[:, :, None] * scale[:, None])
    spread = scale[:, :, None] * vectors / np.sqrt(np.maximum(values, UNMEASURED))[:, None]
    turn = int((axes < 3).sum())
    at_i = np.zeros((len(stated), 6, len(axes)))
    at_i[:, axes] = spread
    at_i = (se3.adjoint(graph.i_from_j) @ at_i)[:, axes]
    rotation = (spread[:, :turn] ** 2).sum(axis=(1, 2)) / turn
    both = (spread[:, turn:] ** 2).sum(axis=(1, 2)) + (at_i[:, turn:] ** 2).sum(axis=(1, 2))
    return rotation, both / (2 * (len(axes) - turn))
