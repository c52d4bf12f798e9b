"""Whether the tracks of a model contradict its intrinsics, which are held."""

from __future__ import annotations

from typing import Literal

from hodge_pipeline.errors import SourceError
from hodge_pipeline.evaluation.difference import alike
from hodge_pipeline.refine.candidates import Found, adjusted_model
from hodge_pipeline.refine.judge import costs
from hodge_pipeline.stages import Steps, TrackedModel

FREE: dict[Literal["focal", "all"], tuple[str, float]] = {
    "focal": ("bundle adjustment with free focal lengths", 0.05),
    "all": ("bundle adjustment with free intrinsics", 0.2),
}
"""What is freed, and the least gain that contradicts it, of the mean error: less is a lens that does not quite fit. Where
a focal length is 3 % off 15 % are gained in lund_door and 43 % in a rendered room; in models as COLMAP leaves them
nothing is. COLMAP holds principal points, so that freeing them gains a few per cent in any model.
"""
LEAST_LEFT = 10
"""Numbers to an image that observations have beyond what points and poses take: of fewer anything fits better."""


def intrinsics_doubt(found: Found, steps: Steps) -> str:
    """Why poses may be wrong where the best candidate that moves them fits much better with free intrinsics; empty where
    it does not, where these are refined anyway, and where the input's poses fit much better than any moved ones.
    """
    at = min((row for row, one in enumerate(found.candidates) if not one.holds_poses), default=0, key=found.px)
    model = found.candidates[at].model
    left = 2 * len(model.quality.errors_px) - 3 * model.quality.points - 6 * len(model.body_names)
    if not at or model.moves_intrinsics or left < LEAST_LEFT * model.quality.images:
        return ""
    if not (1 - FREE["focal"][1]) * found.px(at) <= found.px(found.best):
        return ""
    doubt, least = "", 1.0
    for what, (title, gain) in FREE.items():
        free = _freed(model, what, title, steps)
        if free is None:
            continue
        held, freed = costs([model.quality], [model.quality, free.quality])[1:]
        if freed.px <= (1 - gain) * held.px and freed.px <= (1 - gain) * least * held.px:
            least = freed.px / held.px
            error = f"mean error {' → '.join(alike(held.px, freed.px, 3))} px"
            told = ", ".join((*free.notes, error))
            doubt = f"in doubt, since tracks contradict the intrinsics ({told}): --refine {what}"
    return doubt


def _freed(model: TrackedModel, what: Literal["focal", "all"], title: str, steps: Steps) -> TrackedModel | None:
    """The model after an adjustment of its intrinsics too; None where that fails."""
    key, free = steps.key([model, title]), model.with_free_intrinsics(what)
    steps.remember(free, key)
    try:
        adjusted = steps.step(adjusted_model, free, None, None, title=title)
    except SourceError:
        return None
    return free.read_back(adjusted.folder, ())
