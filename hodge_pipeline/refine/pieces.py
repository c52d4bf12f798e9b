"""Parts of a model that share no points: nothing tells how they lie to each other."""

from __future__ import annotations

import numpy as np

from hodge_pipeline.complex.components import connected_components
from hodge_pipeline.refine.reprojection_cost import named
from hodge_pipeline.types import Bools
from hodge_pipeline.types.tracked_model import TrackedModel

LEAST_SHARED = 3
"""Points that fix a pose."""


def pieces_doubt(model: TrackedModel) -> str:
    """Which bodies of a model share too few points with its largest piece; "" where none does."""
    names = [str(name) for name, apart in zip(model.body_names, apart_from_largest(model), strict=True) if apart]
    if not names:
        return ""
    return f"in doubt, since {named(names)} share{'s' * (len(names) == 1)} no points with the others, or too few"


def apart_from_largest(model: TrackedModel) -> Bools:
    """Bodies (B,) that points do not tie to the largest piece: with fewer than `LEAST_SHARED` points that other bodies
    see, or in a piece of their own.
    """
    quality, count = model.quality, len(model.body_names)
    seen = np.unique(np.stack([model.body_of_frame[quality.keypoints[:, 0]], quality.point_rows], axis=1), axis=0)
    while True:
        shared = np.bincount(seen[:, 1], minlength=quality.points)[seen[:, 1]] > 1
        enough = np.bincount(seen[shared, 0], minlength=count) >= LEAST_SHARED
        kept = shared & enough[seen[:, 0]]
        if kept.all():
            break
        seen = seen[kept]
    piece = connected_components(seen + np.array([0, count]), count + quality.points)[:count]
    sizes = np.bincount(piece, enough)
    return np.asarray(~enough | (piece != np.argmax(sizes)))
