"""Bind plain data to typed options with stages by name, and back; every error names its file and line."""

from __future__ import annotations

import dataclasses
import types
import typing
from collections.abc import Callable, Mapping
from math import inf
from pathlib import Path
from typing import Any, TypeVar, get_args, get_origin, get_type_hints

from pydantic import TypeAdapter, ValidationError
from pydantic.json_schema import GenerateJsonSchema, JsonSchemaValue

from hodge_pipeline import registry
from hodge_pipeline.errors import RecipeError
from hodge_pipeline.store.yaml_file import Keys

T = TypeVar("T")
Where = Callable[[Keys], str]
"""Gives `file:line` of a path of keys."""
WORDS = {float: "number", int: "whole number", bool: "true or false", str: "text", type(None): "nothing"}
"""Types in the words of an error."""
IN_WORDS = {"path_type": "expected a path", "too_short": "expected more items", "tuple_type": "expected a list"}
"""What pydantic says of a wrong value in words of its own code, said in those of a recipe."""
KIND = "x-stage-kind"
"""The key that marks a stage of a kind in a schema that is not linked yet."""


def bind(cls: type[T], data: Any, where: Where, keys: Keys = (), *, seed: int | None = None) -> T:
    """An instance of a pydantic dataclass from a mapping, with its sections and stages.

    A stage with an option `seed` that is not given takes the seed of the section around it, so that the one seed of a
    recipe reaches everything random. Raises `RecipeError`: `file:line: key: what was expected`, with the nearest known
    name of an unknown key.
    """
    if not isinstance(data, Mapping):
        raise RecipeError(f"{where(keys)}: {_dotted(keys)}: expected a mapping of options, got {data!r}", keys)
    hints = get_type_hints(cls)
    known = {field.name: hints[field.name] for field in dataclasses.fields(cls)}  # type: ignore[arg-type]
    for key in data:
        if key not in known:
            here = (*keys, key)
            suggestion = _option_of_a_stage((*keys, key), data, known) or registry.suggestion(key, list(known))
            raise RecipeError(f"{where(here)}: {_dotted(here)}: unknown option{suggestion}", here)
    if isinstance(data.get("seed"), int):
        seed = data["seed"]
        if seed < 0:  # here, not at the stage that it would reach first
            here = (*keys, "seed")
            raise RecipeError(f"{where(here)}: {_dotted(here)}: expected a whole number from 0, got {seed}", here)
    elif "seed" in known and seed is not None:
        data = {**data, "seed": seed}
    values = {key: _value(known[key], value, where, (*keys, key), seed) for key, value in data.items()}
    try:
        return cls(**values)
    except ValidationError as error:
        raise _first_error(error, where, keys, known) from error


def _option_of_a_stage(keys: Keys, data: Mapping[str, Any], known: Mapping[str, Any]) -> str:
    """A suggestion where a stage of this section has an option of the last key's name; "" where none has."""
    for name, annotation in known.items():
        kind = next(filter(None, map(registry.kind_of, (annotation, *get_args(annotation)))), None)
        stage = data[name].get("stage") if isinstance(data.get(name), Mapping) else data.get(name)
        cls = registry.load(kind.name, stage) if kind and stage in registry.names(kind.name) else None
        if cls and any(field.name == keys[-1] for field in dataclasses.fields(cls)):
            return f" (did you mean '{_dotted((*keys[:-1], name, keys[-1]))}'?)"
    return ""


def bind_known(
    cls: type[T], data: dict[str, Any], where: Where, otherwise: dict[str, Any]
) -> tuple[T, tuple[str, ...]]:
    """What `bind` makes of the options that this version knows, and the error of each that was left out.

    `otherwise` holds sections to take where nothing of them is left.
    """
    left_out: list[str] = []
    data = {**otherwise, **data}
    while True:
        try:
            return bind(cls, data, where), tuple(left_out)
        except RecipeError as error:
            if not error.keys or error.keys[0] not in data:
                raise
            left_out.append(str(error))
            data = {**otherwise, **_without(data, error.keys)}


def _without(data: Any, keys: Keys) -> Any:
    """A copy of the data without what is at the path of keys, or at the longest part of it that exists."""
    head, rest = keys[0], keys[1:]
    copy = data.copy()
    inside = data[head]
    if rest and (isinstance(inside, list) or (isinstance(inside, dict) and rest[0] in inside)):
        copy[head] = _without(inside, rest)
    else:
        del copy[head]
    return copy


def _value(annotation: Any, value: Any, where: Where, keys: Keys, seed: int | None) -> Any:
    """A field's value with its stages and sections built; anything else is left to pydantic."""
    if value is None and not registry.kind_of(annotation):
        return None
    if get_origin(annotation) in (typing.Union, types.UnionType):
        inner = [arg for arg in get_args(annotation) if registry.kind_of(arg) or _is_section(arg)]
        return (
            _value(inner[0], value, where, keys, seed) if inner else _number(get_args(annotation), value, where, keys)
        )
    kind = registry.kind_of(annotation)
    if kind:
        return bind_stage(kind.name, value, where, keys, seed)
    if get_origin(annotation) is tuple and isinstance(value, list):
        item = get_args(annotation)[0]
        return tuple(_value(item, each, where, (*keys, row), seed) for row, each in enumerate(value))
    if not _is_section(annotation):
        return _number((annotation,), value, where, keys)
    if isinstance(value, Mapping) and value.get("stage") == registry.name_of_class(annotation):
        value = {key: item for key, item in value.items() if key != "stage"}  # an option that takes this stage alone
    return bind(annotation, value, where, keys, seed=seed)


def _number(types_: tuple[Any, ...], value: Any, where: Where, keys: Keys) -> Any:
    """The value of an option of these types. Raises `RecipeError` for what pydantic takes for a number but is none.

    That is a truth value, and infinity unless the option is a limit.
    """
    is_number = bool({int, float} & set(types_))
    is_limit = str(keys[-1]).startswith("max_") or "limit" in str(keys[-1])
    if (is_number and isinstance(value, bool) and bool not in types_) or (value in (inf, -inf) and not is_limit):
        raise RecipeError(f"{where(keys)}: {_dotted(keys)}: expected a finite number, got {value!r}", keys)
    return value


def bind_stage(kind: str, value: Any, where: Where, keys: Keys, seed: int | None = None) -> Any:
    """The stage of `{stage: name, option: …}` or of a name alone. Raises `RecipeError` as `bind`."""
    options = {"stage": value} if isinstance(value, str) else value
    if not isinstance(options, Mapping) or not isinstance(options.get("stage"), str):
        known = ", ".join(registry.names(kind))
        raise RecipeError(f"{where(keys)}: {_dotted(keys)}: expected {{stage: NAME, …}} with a NAME of: {known}", keys)
    try:
        cls = registry.load(kind, options["stage"])
    except RecipeError as error:
        raise RecipeError(f"{where((*keys, 'stage'))}: {_dotted(keys)}: {error}", keys) from error
    return bind(cls, {key: item for key, item in options.items() if key != "stage"}, where, keys, seed=seed)


def stage_of(kind: str, given: Any, options: Mapping[str, Any], where: str) -> Any:
    """The stage that a caller in Python gave: a name with options, or the stage itself.

    Raises `RecipeError`, which begins with `where`.
    """
    if isinstance(given, str):
        return bind_stage(kind, {**options, "stage": given}, lambda keys: where, (kind,))
    if not isinstance(given, registry.KINDS[kind].protocol):
        raise RecipeError(f"{where}: {given!r} is no stage of kind '{kind}': give one, or a name of those registered")
    if options:
        raise RecipeError(f"{where}: options ({', '.join(options)}) go with a name: set them on the stage itself")
    return given


def unbind(value: Any) -> Any:
    """Options as plain data that `bind` reads back, with every default; a stage as `{stage: name, …}`."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = {field.name: unbind(getattr(value, field.name)) for field in dataclasses.fields(value)}
        return {"stage": registry.name_of(value), **fields} if _is_stage(value) else fields
    if isinstance(value, Mapping):
        return {str(key): unbind(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [unbind(item) for item in value]
    return str(value) if isinstance(value, Path) else value


def _is_stage(value: Any) -> bool:
    """Whether it has the methods of a kind of stage; data that only have the names of methods are none."""
    protocols = [kind.protocol for kind in registry.KINDS.values() if isinstance(value, kind.protocol)]
    return any(
        all(callable(getattr(value, name)) for name in vars(protocol) if not name.startswith("_"))
        for protocol in protocols
    )


def _spelled(annotation: Any) -> str:
    """A type in the words of a recipe."""
    origin, parts = get_origin(annotation), get_args(annotation)
    if origin in (typing.Union, types.UnionType):
        return " or ".join(_spelled(part) for part in parts)
    if origin is typing.Literal:
        return " or ".join(map(repr, parts))
    if origin is tuple:
        return f"[{', '.join('…' if part is ... else _spelled(part) for part in parts)}]"
    return WORDS.get(annotation, str(annotation))


def _is_section(annotation: Any) -> bool:
    return isinstance(annotation, type) and dataclasses.is_dataclass(annotation)


def _dotted(keys: Keys) -> str:
    return ".".join(map(str, keys)) or "recipe"


def _first_error(error: ValidationError, where: Where, keys: Keys, known: Mapping[str, Any]) -> RecipeError:
    """The first of pydantic's errors as one line with its key; of an option of several types, these types."""
    first = error.errors()[0]
    field = first["loc"][0] if first["loc"] else None
    if isinstance(field, str) and len({other["loc"][1:2] for other in error.errors() if other["loc"][0] == field}) > 1:
        given, here = error.errors()[0]["input"], (*keys, field)
        return RecipeError(f"{where(here)}: {_dotted(here)}: expected {_spelled(known[field])}, got {given!r}", here)
    here = (*keys, *(key for key in first["loc"] if isinstance(key, (str, int))))
    while len(here) > len(keys) and isinstance(here[-1], str) and "-" in here[-1]:
        here = here[:-1]
    what = IN_WORDS.get(first["type"]) or first["msg"][0].lower() + first["msg"][1:]
    if first["type"] == "missing":
        return RecipeError(f"{where(keys)}: {_dotted(here)}: this option is required", keys)
    if first["type"] == "value_error":  # a stage's own words; its input is no option's value
        return RecipeError(f"{where(here)}: {_dotted(here)}: {first['ctx']['error']}", here)
    return RecipeError(f"{where(here)}: {_dotted(here)}: {what.rstrip('.')}, got {first['input']!r}", here)


class _StageSchema(GenerateJsonSchema):
    """Makes JSON schemas in which a field typed by a stage's Protocol is marked with the kind of stage."""

    def is_instance_schema(self, schema: Any) -> JsonSchemaValue:
        """A mark of the kind, of which `_linked` makes a reference, since pydantic refuses those of others."""
        kind = registry.kind_of(schema["cls"])
        return {KIND: kind.name} if kind else super().is_instance_schema(schema)

    def dataclass_schema(self, schema: Any) -> JsonSchemaValue:
        """The schema of a section, in which `stage: name` may stand where the section is a stage, as `bind` allows."""
        found, name = super().dataclass_schema(schema), registry.name_of_class(schema["cls"])
        if ":" not in name:
            found["properties"] = {"stage": {"const": name}, **found.get("properties", {})}
        return found


def json_schema(cls: type) -> dict[str, Any]:
    """The JSON schema (draft 2020-12) of a recipe with all installed stages, for editors; without broken plugins."""
    schema: dict[str, Any] = TypeAdapter(cls).json_schema(schema_generator=_StageSchema)
    definitions = schema.setdefault("$defs", {})
    for kind in registry.KINDS:
        options = []
        for name in registry.names(kind):
            try:
                options.append(_stage_schema(kind, name, definitions))
            except RecipeError:
                continue
        definitions[f"kind-{kind}"] = {"anyOf": options} if options else {"type": "object"}
    return dict(_linked(schema))


def _stage_schema(kind: str, name: str, definitions: dict[str, Any]) -> dict[str, Any]:
    """The schema of a stage, its name alone or with options; its sections are added to the definitions."""
    stage = TypeAdapter(registry.load(kind, name)).json_schema(schema_generator=_StageSchema)
    definitions.update(stage.pop("$defs", {}))
    stage["properties"] = {**stage.get("properties", {}), "stage": {"const": name}}
    stage["required"] = ["stage", *stage.get("required", [])]
    return {"anyOf": [{"const": name}, stage]}


def _linked(node: Any) -> Any:
    """The schema with a reference to the definition of the kind in place of each mark."""
    if isinstance(node, list):
        return [_linked(item) for item in node]
    if not isinstance(node, dict):
        return node
    linked = {key: _linked(value) for key, value in node.items() if key != KIND}
    return {**linked, "$ref": f"#/$defs/kind-{node[KIND]}"} if isinstance(node.get(KIND), str) else linked
