"""Advice after a diagnosis: the edges in the order of their urgency, and what to do about each."""

from __future__ import annotations

import numpy as np

from hodge_pipeline.diagnosis.result import CONSISTENT, SUSPECT, UNTESTABLE, WORST_FIRST, WRONG, Diagnosis
from hodge_pipeline.types import Bools, Ints

SPLITS = 1 - 1e-6
"""Leverage from which an edge is a bridge of the graph."""


def ranked(diagnosis: Diagnosis) -> Ints:
    """Rows of all edges, the worst first: wrong, suspect, untestable, consistent; in each the least probable, and of
    those as probable to a tenth the farthest from the poses, those that join two pieces before them.
    """
    place = np.argmax(diagnosis.verdict[:, None] == np.array(WORST_FIRST), axis=1)
    probability = np.nan_to_num(diagnosis.probability, nan=0.5)
    return np.lexsort((-np.nan_to_num(diagnosis.residual_m, nan=np.inf), probability.round(1), place))


def advice(diagnosis: Diagnosis, disabled: Bools, harmless: Bools) -> tuple[str, ...]:
    """What to do about each edge, in a few words; `disabled (E,)` are off already, `harmless (E,)` bend no pose."""
    columns = zip(
        diagnosis.verdict.tolist(),
        disabled.tolist(),
        harmless.tolist(),
        diagnosis.cycles.loops.missing(len(disabled)).tolist(),
        diagnosis.leverage,
        strict=True,
    )
    return tuple(_advice(*each) for each in columns)


def _advice(verdict: str, is_disabled: bool, is_harmless: bool, in_no_listed_cycle: bool, leverage: float) -> str:
    if is_disabled:
        return "is disabled; nothing speaks against it: enable it again" if verdict == CONSISTENT else "is disabled"
    if verdict == WRONG:
        return "nothing: no pose depends on it" if is_harmless else "disable it"
    if verdict == SUSPECT:
        return "look at it; disable it where the views do not meet"
    if verdict == UNTESTABLE:
        return (
            "register another pair across it"
            if in_no_listed_cycle
            else "look at the loop's edges, or register a pair across it"
        )
    return "keep it: without it the scene falls apart" if leverage >= SPLITS else "keep it"
