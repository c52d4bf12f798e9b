"""Options of solvers given as plain arguments, which no recipe has checked."""

from __future__ import annotations

from typing import Any, get_args

from hodge_pipeline.errors import GraphError


def check_choice(name: str, value: object, choices: Any) -> None:
    """Raises `GraphError` that lists the choices where the value is none of a `Literal` type's."""
    if value not in get_args(choices):
        raise GraphError(f"{name} {value!r} does not exist: take {' or '.join(map(repr, get_args(choices)))}")
