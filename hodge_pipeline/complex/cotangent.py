"""Cotangent weights of a triangulated surface from its edge lengths (paper, Section 4, Eqs. (8) and (9))."""

from __future__ import annotations

import numpy as np

from hodge_pipeline.complex.embedding import Surface
from hodge_pipeline.errors import GraphError
from hodge_pipeline.types import Floats

COT_60_DEG = 1 / np.sqrt(3)


def cotangent_weights(surface: Surface, lengths: Floats | None = None) -> Floats:
    """`w = ½ (cot α + cot β)` (E + D,), α and β the angles opposite each edge; unit lengths give 1/√3 throughout.

    A side in a digon or monogon, which has no angle, counts as 60°: so a lone edge has 1/√3 too. Weights are negative
    where α + β > 180°. Raises `GraphError` where the sides of a triangle do not close.
    """
    lengths = np.ones(len(surface.edges)) if lengths is None else np.asarray(lengths, float)
    if lengths.shape != (len(surface.edges),):
        raise GraphError(f"a metric needs {len(surface.edges)} edge lengths, one for each edge of the surface")
    faces = surface.faces
    starts = faces.offsets[:-1][faces.lengths == 3]
    sides = faces.edge[starts[:, None] + np.arange(3)]
    cotangents = _cotangents(lengths[sides])
    count = len(surface.edges)
    weight = np.bincount(sides.ravel(), cotangents.ravel(), minlength=count)
    in_triangles = np.bincount(sides.ravel(), minlength=count)
    return np.asarray((weight + (2 - in_triangles) * COT_60_DEG) / 2)


def _cotangents(sides: Floats) -> Floats:
    """The cotangents (T, 3) of the angles opposite each of three sides."""
    squares = sides**2
    total = squares.sum(axis=1)
    sixteen_area_squared = total**2 - 2 * (squares**2).sum(axis=1)
    if not (sixteen_area_squared > 0).all() or not (sides > 0).all():
        row = int(np.flatnonzero(~(sixteen_area_squared > 0) | ~(sides > 0).all(axis=1))[0])
        raise GraphError(f"triangle {row} with sides {sides[row].tolist()} does not close: no metric has such lengths")
    return np.asarray((total[:, None] - 2 * squares) / np.sqrt(sixteen_area_squared)[:, None])
