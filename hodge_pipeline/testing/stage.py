"""What the contracts of all kinds of stages share: every stage's own promises, and how properties are checked."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Collection, Mapping
from typing import Any, TypeVar

Stage = TypeVar("Stage")


def check_stage(stage: object) -> None:
    """Assert that it pickles and cannot be changed."""
    assert type(stage) is type(pickle.loads(pickle.dumps(stage))), "the stage does not pickle"
    assert pickle.loads(pickle.dumps(stage)) == stage, "the stage pickled is not equal to itself: is it a dataclass?"
    try:
        stage.made_by_a_check = True  # type: ignore[attr-defined]
    except Exception:  # noqa: BLE001 - whatever it raises, it refused
        return
    raise AssertionError("the stage can be changed: make it a frozen dataclass")


def check_kind(stage: object, protocol: type) -> None:
    """Assert that it is a stage of this kind: it has the methods, pickles, is hashable and cannot be changed."""
    assert isinstance(stage, protocol), f"it lacks a method of {protocol.__name__}"
    check_stage(stage)
    try:
        hash(stage)
    except TypeError as error:
        raise AssertionError(f"the stage has no hash, by which workers know it: {error}") from error


def check_properties(
    table: Mapping[str, Callable[[Stage], None]],
    stage: Stage,
    lacks: Collection[str],
    properties: Collection[str] | None,
) -> None:
    """Check the properties of a table, or those that are named, on one stage.

    Those that a stage does not have by its nature are declared in `lacks`, and must then fail. Raises
    `AssertionError` that says which property does not hold, and why.
    """
    unknown = {*lacks, *(properties or ())} - {*table}
    assert not unknown, f"no such property: {sorted(unknown)}; there are {list(table)}"
    for name in table if properties is None else properties:
        try:
            table[name](stage)
        except Exception as error:
            if name in lacks:
                continue
            why = str(error) if isinstance(error, AssertionError) else f"raises {type(error).__name__}: {error}"
            raise AssertionError(f"{name}: {why}") from error
        assert name not in lacks, f"{name}: declared as lacking, but it holds: take it out of `lacks`"


def raises(error: type[Exception], call: Callable[[], Any]) -> str | None:
    """The message of the error that the call raises, None where it raises none; another error is raised."""
    try:
        call()
    except error as raised:
        return str(raised)
    return None
