"""Whether the tracks of a model contradict its intrinsics or rigs, which bundle adjustment holds."""

from __future__ import annotations

from typing import Literal

from hodge_pipeline.errors import SourceError
from hodge_pipeline.evaluation.difference import alike
from hodge_pipeline.refine.candidates import CandidateSet, adjusted_model
from hodge_pipeline.refine.reprojection_cost import ENOUGH_SEEN, FINEST_PX, costs, degrees_of_freedom
from hodge_pipeline.stages import Steps
from hodge_pipeline.types.tracked_model import TrackedModel

FREE: dict[Literal["rig", "focal", "all"], tuple[str, str, float]] = {
    "rig": ("the rig's calibration", "bundle adjustment with free rigs", 0.05),
    "focal": ("the intrinsics", "bundle adjustment with free focal lengths", 0.05),
    "all": ("the intrinsics", "bundle adjustment with free intrinsics", 0.2),
}
"""What is freed, and the share of the mean error that this must save: a lens model that fits badly causes less. A focal
length that is 3 % off causes 15 % in lund_door and 43 % in a rendered room; models as COLMAP leaves them gain nothing.
Principal points, which COLMAP holds, gain a few per cent in any model. What comes later must save that beyond the best
before it.
"""
LEAST_FREEDOM = 10
"""Degrees of freedom to an image: with fewer any further parameter fits better."""


def intrinsics_doubt(found: CandidateSet, steps: Steps) -> str:
    """Why a model is in doubt: its best candidate that moves poses fits much better with free rigs or intrinsics.

    "" where it does not, where too few observations tell, where these are refined anyway, where that candidate is
    exact, and where the input's poses fit better than any that were moved.
    """
    at = min((row for row, one in enumerate(found.candidates) if not one.holds_poses), default=0, key=found.px)
    model = found.candidates[at].model
    if not at or model.moves_calibration or degrees_of_freedom(model) < LEAST_FREEDOM * model.quality.images:
        return ""
    if found.px(at) < FINEST_PX or (1 - FREE["focal"][-1]) * found.px(at) > found.px(found.best):
        return ""
    part = model.thinned(ENOUGH_SEEN)
    if part is not model:
        steps.remember(part, steps.key([model, ENOUGH_SEEN]))
    doubt, least = "", 1.0
    for what, (whose, title, gain) in FREE.items():
        if what == "rig" and len(model.body_names) == len(model.frames):
            continue
        free = _freed(part, what, title, steps)
        if free is None:
            continue
        held, freed = costs([part.quality], [part.quality, free.quality])[1:]
        if freed.px <= (1 - gain) * least * held.px:
            least, error = freed.px / held.px, f"mean error {' → '.join(alike(held.px, freed.px, 3))} px"
            told = ", ".join((*free.notes, error))
            doubt = f"in doubt, since tracks contradict {whose} ({told}): --refine {what}"
    return doubt


def _freed(model: TrackedModel, what: Literal["rig", "focal", "all"], title: str, steps: Steps) -> TrackedModel | None:
    """The model after an adjustment of these too; None where that fails."""
    key, free = steps.key([model, title]), model.with_free(what)
    steps.remember(free, key)
    try:
        adjusted = steps.step(adjusted_model, free, None, None, title=title)
    except SourceError:
        return None
    return free.read_back(adjusted.folder, ())
