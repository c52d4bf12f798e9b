"""Whether the tracks of a model contradict its focal lengths, which bundle adjustment holds."""

from __future__ import annotations

from hodge_pipeline.errors import SourceError
from hodge_pipeline.evaluation.difference import alike
from hodge_pipeline.refine.candidates import adjusted_model
from hodge_pipeline.refine.judge import costs, degrees_of_freedom
from hodge_pipeline.stages import Steps, TrackedModel

FREE = "bundle adjustment with free focal lengths"
FOCAL_GAIN = 0.05
"""Share of the mean error: a lens model that fits badly causes less. A focal length that is 3 % off causes 15 % in
lund_door and 43 % in a rendered room; models as COLMAP leaves them gain nothing.
"""
LEAST_FREEDOM = 10
"""Degrees of freedom to an image: with fewer any further parameter fits better."""


def focal_doubt(model: TrackedModel, steps: Steps) -> str:
    """Why an adjusted model is in doubt: it fits much better with free focal lengths.

    "" where it does not, where too few observations tell, and where focal lengths are refined anyway.
    """
    if model.moves_intrinsics or degrees_of_freedom(model) < LEAST_FREEDOM * model.quality.images:
        return ""
    key, free = steps.key([model, FREE]), model.with_free_focal_lengths()
    steps.remember(free, key)
    try:
        found = steps.step(adjusted_model, free, None, None, title=FREE)
    except SourceError:
        return ""
    adjusted = free.read_back(found.folder, ())
    held, freed = costs([model.quality], [model.quality, adjusted.quality])[1:]
    if not freed.px <= (1 - FOCAL_GAIN) * held.px:
        return ""
    error = f"mean error {' → '.join(alike(held.px, freed.px, 3))} px"
    return f"in doubt, since tracks contradict the intrinsics ({', '.join((*adjusted.notes, error))}): --refine focal"
