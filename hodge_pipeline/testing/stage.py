"""What the contracts of all kinds of stages share: every stage's own promises, and how properties are checked."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

Case = TypeVar("Case")
IS_A_STAGE = "is a stage"


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


@dataclass(frozen=True)
class Contract(Generic[Case]):
    """The check of one kind of stage: called with a stage, and what else `case` takes, it asserts each of `promises`,
    and first that the stage has the methods of its `protocol`, pickles, is hashable and cannot be changed.
    """

    protocol: type
    promises: Mapping[str, Callable[[Case], None]]
    case: Callable[..., Case] = lambda stage: stage  # noqa: E731

    @property
    def properties(self) -> tuple[str, ...]:
        """What is checked, by name."""
        return (IS_A_STAGE, *self.promises)

    def __call__(
        self, stage: object, *given: Any, lacks: Collection[str] = (), properties: Collection[str] | None = None
    ) -> None:
        """Check all properties, or those that are named. One that the stage does not have by its nature is declared in
        `lacks`, and must then fail. Raises `AssertionError` that says which property does not hold, and why.
        """
        unknown = {*lacks, *(properties or ())} - {*self.properties}
        assert not unknown, f"no such property: {sorted(unknown)}; there are {list(self.properties)}"
        for name in self.properties if properties is None else properties:
            try:
                if name == IS_A_STAGE:
                    check_kind(stage, self.protocol)
                else:
                    self.promises[name](self.case(stage, *given))
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
