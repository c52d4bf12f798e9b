"""The contract of every stage."""

from __future__ import annotations

import pickle


def check_stage(stage: object) -> None:
    """Assert that it pickles and cannot be changed."""
    assert type(stage) is type(pickle.loads(pickle.dumps(stage))), "the stage does not pickle"
    assert pickle.loads(pickle.dumps(stage)) == stage, "the stage pickled is not equal to itself: is it a dataclass?"
    try:
        stage.made_by_a_check = True  # type: ignore[attr-defined]
    except Exception:  # noqa: BLE001 - whatever it raises, it refused
        return
    raise AssertionError("the stage can be changed: make it a frozen dataclass")
