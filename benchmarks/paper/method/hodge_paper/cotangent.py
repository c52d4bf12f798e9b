"""Cotangent weights of a triangulated surface (paper, Section 4, Eqs. (8) and (9))."""

from __future__ import annotations

import numpy as np

from hodge_paper.embedding import Surface
from hodge_pipeline.types import Floats

COT_60_DEG = 1 / np.sqrt(3)


def cotangent_weights(surface: Surface) -> Floats:
    """`w = ½ (cot α + cot β)` (E + D,), α and β the angles opposite each edge of the surface.

    All edges have the length 1, so that each angle is 60° and w is 1/√3. A side in a digon or monogon, which has no
    angle, counts as 60° too.
    """
    return np.full(len(surface.edges), COT_60_DEG)
