"""Whether the tracks of a model contradict its focal lengths, which are held."""

from __future__ import annotations

from hodge_pipeline.errors import SourceError
from hodge_pipeline.evaluation.difference import alike
from hodge_pipeline.refine.candidates import adjusted_model
from hodge_pipeline.refine.judge import costs
from hodge_pipeline.stages import Steps, TrackedModel

FREE = "bundle adjustment with free focal lengths"
GAIN = 0.05
"""Of the mean error: less is a lens that does not quite fit. Where a focal length is 3 % off 15 % are gained in
lund_door and 43 % in a rendered room; in models as COLMAP leaves them nothing is.
"""
LEAST_LEFT = 10
"""Numbers to an image that observations have beyond what points and poses take: of fewer anything fits better."""


def focal_doubt(model: TrackedModel, steps: Steps) -> str:
    """Why poses may be wrong where an adjusted model fits much better with free focal lengths; empty where it does not,
    and where these are refined anyway.
    """
    left = 2 * len(model.quality.errors_px) - 3 * model.quality.points - 6 * len(model.body_names)
    if model.moves_intrinsics or left < LEAST_LEFT * model.quality.images:
        return ""
    key, free = steps.key([model, FREE]), model.with_free_focal_lengths()
    steps.remember(free, key)
    try:
        found = steps.step(adjusted_model, free, None, None, title=FREE)
    except SourceError:
        return ""
    adjusted = free.read_back(found.folder, ())
    held, freed = costs([model.quality], [model.quality, adjusted.quality])[1:]
    if not freed.px <= (1 - GAIN) * held.px:
        return ""
    error = f"mean error {' → '.join(alike(held.px, freed.px, 3))} px"
    return f"in doubt, since tracks contradict the intrinsics ({', '.join((*adjusted.notes, error))}): --refine focal"
