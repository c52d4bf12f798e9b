"""Scalar weights of the isotropic objective from 6x6 information, and what is wrong with an information matrix."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from hodge_pipeline.complex.chi2 import UNMEASURED
from hodge_pipeline.complex.components import connected_components
from hodge_pipeline.solvers.priors import SOURCE
from hodge_pipeline.types import Bools, Floats, Ints, ViewGraph
from hodge_pipeline.types.text import counted

PLANAR_AXES = np.array([2, 3, 4])
"""(θ, x, y) in (φ, ρ)."""
OUT_OF_PLANE = np.array([0, 1, 5])
PLANAR_TOLERANCE = 1e-12
"""What rounding leaves out of the plane; motions that were lifted from it have zeros."""
INDEFINITE_TOLERANCE = 1e-9
"""Share of the largest eigenvalue up to which a negative one is rounding."""
EARTH_M = 1.2742e7
"""The earth's diameter: a longer edge is a unit or a measurement gone wrong."""
RESOLVED = float(1 / np.finfo(float).eps)
"""Ratio of weights beyond which the smaller terms of a cost are lost in the rounding of the larger."""
UNUSED_PRIOR = (
    "not used: neither all axes of the position nor all of the rotation have information; where the height lacks it, "
    "state one with a large error"
)
"""What is said of priors that no solve can use."""
FLOOR = 1e-9
"""Weight, relative to the median, of a used edge without information on rotation, or on translation."""


@dataclass(frozen=True)
class Weights:
    """Isotropic weights κ, τ (E,), the full information over (φ, ρ), 3x3 for a planar graph, and what was found.

    `used (E,)`: edges that count. `partly (E,)`: those of them that measure neither all axes of the rotation nor all of
    the translation. `definite`: whether every used matrix is positive semi-definite.
    """

    kappa: Floats
    tau: Floats
    information: Floats
    used: Bools
    partly: Bools
    definite: bool
    notes: tuple[str, ...]


def dimension_of(graph: ViewGraph) -> Literal[2, 3]:
    """The dimension of a graph: 2 also for one in space whose edges lie in the plane z = 0 and have no information out
    of it, as a lifted planar graph.
    """
    lifted = moves_in_plane(graph) and not graph.information[:, OUT_OF_PLANE].any()
    return 2 if graph.dimension == 2 or lifted else 3


def moves_in_plane(graph: ViewGraph) -> bool:
    """Whether every edge lies in the plane z = 0 and its errors out of the plane are uncorrelated with those in it."""
    if graph.dimension == 2 or not graph.edge_count:
        return graph.dimension == 2
    motion = graph.i_from_j
    off = np.abs(np.concatenate([motion[:, 2, :2], motion[:, :2, 2], motion[:, 2:3, 3]], axis=1)).max()
    return bool(off < PLANAR_TOLERANCE and not graph.information[:, OUT_OF_PLANE[:, None], PLANAR_AXES].any())


def edge_weights(graph: ViewGraph, dimension: int, full: bool = True) -> Weights:
    """The weights of each edge: τ = d / tr(Ω_t⁻¹); κ = 3 / (2 tr(Ω_R⁻¹)), or Ω_θ in the plane (SE-Sync, section II).

    Edges that measure some axes alone count in the `full` objective, where no information is indefinite and other edges
    hold what they do not measure; κ and τ, those of the axes that they measure, then only lead to its minimum.
    """
    notes: list[str] = []
    information = graph.information
    if dimension == 2:
        information = information[:, PLANAR_AXES[:, None], PLANAR_AXES]
    information = _symmetric(information)
    p = information.shape[-1] - dimension
    kappa = _mean_precision(information[:, :p, :p]) / (2 if dimension == 3 else 1)
    tau = _mean_precision(information[:, p:, p:])
    loops = graph.edges[:, 0] == graph.edges[:, 1]
    used, prior = ((kappa > 0) | (tau > 0)) & ~loops, graph.source == SOURCE
    of_either_sign = _indefinite(information)
    indefinite = of_either_sign & used
    some = ~used & ~loops & ~prior & ~of_either_sign & (np.einsum("eii->ei", information) > 0).any(axis=1)
    can_count = full and some.any() and not indefinite.any()
    partly = some & _joined(graph, (kappa > 0) & (tau > 0)) if can_count else np.zeros_like(used)
    if partly.any():
        used |= partly
        kappa[partly] = _measured_precision(information[partly, :p, :p]) / (2 if dimension == 3 else 1)
        tau[partly] = _measured_precision(information[partly, p:, p:])
        notes.append(f"{counted(int(partly.sum()), 'edge measures|edges measure')} some axes alone, which count")
    if loops.any():
        notes.append(
            f"{counted(int(loops.sum()), 'edge joins|edges join')} a vertex to itself: they say nothing of poses"
        )
    silent, stated = ~used & ~loops, information.any(axis=(1, 2))
    if count := int((silent & prior).sum()):
        notes.append(f"{counted(count, 'prior')} {UNUSED_PRIOR}")
    unheld = "which the full objective takes where other edges that measure all join their vertices"
    for rows, what in (
        (silent & ~stated, "no information"),
        (silent & some, f"information on some axes alone, {unheld}"),
        (silent & stated & ~some, "information that is not positive"),
    ):
        if count := int((rows & ~prior).sum()):
            notes.append(f"{counted(count, 'edge has|edges have')} {what}: ignored")
    lengths = np.where(used, np.linalg.norm(graph.i_from_j[:, :3, 3], axis=1), 0.0)
    if (far := int((lengths > EARTH_M).sum())) > 0:
        i, j = graph.vertex_ids[graph.edges[np.argmax(lengths)]]
        notes.append(
            f"{counted(far, 'edge is|edges are')} longer than the earth, ({i}, {j}) {lengths.max():.2g} m: "
            "check them and the unit"
        )
    if indefinite.any():
        notes.append(f"{int(indefinite.sum())} of {graph.edge_count} information matrices are indefinite")
    stated = np.concatenate([kappa[used], tau[used]])
    stated = stated[stated > 0]
    if len(stated) and stated.max() > RESOLVED * stated.min():
        notes.append(
            f"the information of rotation and translation, or of edges, differs by a factor of more than "
            f"{RESOLVED:.0e}: rounding hides the smaller, and the poses may not be the best: lower the largest"
        )
    told = ~prior & ~partly
    kappa, tau = _floor(kappa, used, told, "rotation", notes), _floor(tau, used, told, "translation", notes)
    return Weights(kappa, tau, information, used, partly, not indefinite.any(), tuple(notes))


def measured_axes(information: Floats) -> Ints:
    """How many axes (E,) each matrix (E, k, k) has information on."""
    size = information.shape[-1]
    if _all_definite(information):
        return np.full(len(information), size)
    diagonal = np.einsum("eii->ei", information)
    scale = 1 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    values = np.linalg.eigvalsh(information * scale[:, :, None] * scale[:, None, :])
    return np.asarray((values > UNMEASURED).sum(axis=1), np.int64)


def _joined(graph: ViewGraph, whole: Bools) -> Bools:
    """Which edges (E,) have ends that a path of `whole (E,)` edges joins, which hold what the edge does not measure."""
    part = connected_components(graph.edges[whole], graph.vertex_count)
    return np.asarray(part[graph.edges[:, 0]] == part[graph.edges[:, 1]])


def _measured_precision(blocks: Floats) -> Floats:
    """The harmonic mean (E,) of the eigenvalues that are not zero, 0 where all are."""
    values = np.linalg.eigvalsh(blocks)
    known = values > UNMEASURED * np.maximum(values[:, -1:], 0.0)
    variances = np.where(known, 1 / np.where(known, values, 1.0), 0.0).sum(axis=1)
    return np.where(variances > 0, known.sum(axis=1) / np.where(variances > 0, variances, 1.0), 0.0)


def _symmetric(matrices: Floats) -> Floats:
    """The symmetric parts (E, k, k): the matrices themselves where they are symmetric, for the memory of a copy."""
    pairs = [(i, j) for i in range(matrices.shape[-1]) for j in range(i)]
    if all(np.array_equal(matrices[:, i, j], matrices[:, j, i]) for i, j in pairs):
        return matrices
    return np.asarray(0.5 * (matrices + np.swapaxes(matrices, 1, 2)))


def _mean_precision(blocks: Floats) -> Floats:
    """The harmonic mean of the eigenvalues (E,), 0 where one is not positive."""
    if blocks.shape[-1] == 1:
        return np.maximum(blocks[:, 0, 0], 0.0)
    scale = np.abs(blocks).max(axis=(1, 2), initial=0.0)
    safe = np.where(scale > 0, scale, 1.0)[:, None, None]
    a = blocks / safe
    diagonal = np.einsum("eii->ei", a)
    if a.shape[-1] == 2:
        determinant = a[:, 0, 0] * a[:, 1, 1] - a[:, 0, 1] ** 2
        minors = diagonal.sum(axis=1)
    else:
        cofactor = np.stack(
            [
                a[:, 1, 1] * a[:, 2, 2] - a[:, 1, 2] ** 2,
                a[:, 0, 0] * a[:, 2, 2] - a[:, 0, 2] ** 2,
                a[:, 0, 0] * a[:, 1, 1] - a[:, 0, 1] ** 2,
            ],
            axis=1,
        )
        determinant = np.linalg.det(a)
        minors = cofactor.sum(axis=1)
    positive = (determinant > 0) & (minors > 0) & (diagonal.sum(axis=1) > 0)
    mean = a.shape[-1] * determinant / np.where(positive, minors, 1.0)
    return np.asarray(np.where(positive, mean, 0.0) * scale)


def _indefinite(information: Floats) -> Bools:
    """Where (E,) a matrix has a negative eigenvalue beyond rounding, in units that make its diagonal one."""
    if not len(information):
        return np.zeros(0, bool)
    same = bool((information == information[:1]).all())
    checked = information[:1] if same else information
    diagonal = np.einsum("eii->ei", checked)
    scale = 1 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    scaled = checked * scale[:, :, None] * scale[:, None, :]
    if _all_definite(scaled):
        return np.zeros(len(information), bool)
    eigenvalues = np.linalg.eigvalsh(scaled)
    found = (eigenvalues[:, 0] < -INDEFINITE_TOLERANCE * np.maximum(eigenvalues[:, -1], 0)) | (diagonal < 0).any(axis=1)
    return np.broadcast_to(found, len(information)) if same else np.asarray(found)


def _all_definite(matrices: Floats) -> bool:
    """Whether every matrix (E, k, k) has a Cholesky factor: a cheap test that most graphs pass."""
    try:
        np.linalg.cholesky(matrices)
    except np.linalg.LinAlgError:
        return False
    return True


def _floor(weights: Floats, used: Bools, told: Bools, what: str, notes: list[str]) -> Floats:
    """The weights with the zeros of used edges raised to almost zero, so that every Laplacian is connected; a note
    counts those `told (E,)`, which priors are not: they may well state a place alone.
    """
    uninformed = used & (weights <= 0)
    if not uninformed.any():
        return weights
    positive = weights[used & (weights > 0)]
    if count := int((uninformed & told).sum()):
        notes.append(
            f"{counted(count, 'edge has|edges have')} no definite information on {what}: the full objective takes what "
            "is stated, the isotropic one almost nothing"
        )
    return np.where(uninformed, FLOOR * np.median(positive) if len(positive) else 1.0, weights)
