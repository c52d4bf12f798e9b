"""Writes `docs/recipes.md`, field by field from the models: `python tools/recipe_reference.py`."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, get_args, get_type_hints

from hodge_pipeline import registry
from hodge_pipeline.errors import HodgeError
from hodge_pipeline.recipe import binding, recipe_file
from hodge_pipeline.recipe.schema import Recipe
from hodge_pipeline.store import yaml_file

PAGE = Path(__file__).resolve().parents[1] / "docs" / "recipes.md"
OURS = "hodge-pipeline "
HEAD = """# Recipes

Written by `python tools/recipe_reference.py` from the code. A recipe is YAML, and data: it never executes anything.

- `extends: NAME` takes everything from another recipe and changes what follows.
- A stage is its name (`solver: robust`) or `{stage: robust, option: value}`; an option not given has its default.
- `--set a.b=c` changes one option from the command line, `--source PATH` the input.
- A Dask cluster is named on the command line, never by a recipe: `--dask tcp://HOST:8786` ([security.md](security.md)).
- `hodge recipes NAME` prints a recipe with every default; `hodge recipes --schema` is a JSON schema for an editor.
- A mistake is one line with file, line, key and the nearest name that exists.
"""


def page() -> str:
    """The whole page."""
    return "\n".join([HEAD, *_recipes(), *_sections(), *_stages()]).rstrip() + "\n"


def _recipes() -> Iterator[str]:
    yield "## The recipes that come with the package\n"
    yield "| recipe | for |\n|---|---|"
    for name in recipe_file.recipe_names():
        yield f"| `{name}` | {_cell(recipe_file.load(name).data.get('description', ''))} |"
    yield ""


def _sections() -> Iterator[str]:
    yield "## The recipe\n"
    hints = get_type_hints(Recipe)
    yield from _table(Recipe)
    for field in dataclasses.fields(Recipe):
        for part in (hints[field.name], *get_args(hints[field.name])):
            if isinstance(part, type) and dataclasses.is_dataclass(part):
                yield f"### `{field.name}`\n"
                yield f"{_first_line(part)}\n"
                yield from _table(part)


def _stages() -> Iterator[str]:
    for kind in registry.KINDS.values():
        names = [name for name in registry.names(kind.name) if registry.origin(kind.name, name).startswith(OURS)]
        if not names:
            continue
        yield f"## Stages: {kind.name}\n"
        yield f"They {kind.summary}.\n" if not kind.summary.startswith(("where", "what")) else f"{kind.summary}.\n"
        stages = {name: _loaded(kind.name, name) for name in names}
        plain = {name: stage for name, stage in stages.items() if not _fields(stage)}
        if plain:
            yield "| stage without options | what |\n|---|---|"
            yield from (f"| `{name}` | {_cell(_first_line(stage))} |" for name, stage in plain.items())
            yield ""
        for name, stage in stages.items():
            if name not in plain:
                base = next((other for other in stages if other != name and stages[other] in stage.__mro__), None)
                yield f"### `{name}`\n"
                yield f"{_first_line(stage)}{f' Also takes the options of `{base}`.' if base else ''}\n"
                yield from _table(stage, _fields(stages[base]) if base else {})


def _loaded(kind: str, name: str) -> Any:
    """The stage, or why it does not load here."""
    try:
        return registry.load(kind, name)
    except HodgeError as error:
        return f"Does not load here: {error}"


def _fields(cls: Any) -> dict[str, Any]:
    return getattr(cls, "__pydantic_fields__", {})


def _table(cls: Any, told: Mapping[str, Any] = MappingProxyType({})) -> Iterator[str]:
    """The options, but those `told` elsewhere with the same default and meaning."""
    fields = {name: each for name, each in _fields(cls).items() if name not in told or _row(each) != _row(told[name])}
    if not fields:
        return
    yield "| option | default | what |\n|---|---|---|"
    for name, field in fields.items():
        yield f"| `{name}` | {_row(field)} |"
    yield ""


def _row(field: Any) -> str:
    return f"{_default(field)} | {_cell(_meaning(field))}"


def _meaning(field: Any) -> str:
    is_section = not field.is_required() and dataclasses.is_dataclass(field.default)
    return field.description or (_first_line(type(field.default)) if is_section else "")


def _default(field: Any) -> str:
    if field.is_required():
        return "must be given"
    value = field.get_default(call_default_factory=True)
    if dataclasses.is_dataclass(value):
        return "see below"
    plain = binding.unbind(value)
    if plain is None:
        return "none"
    return f"`{yaml_file.dump({'x': plain}).strip().removeprefix('x:').strip() or plain}`".replace("\n", " ")


def _first_line(cls: Any) -> str:
    return cls if isinstance(cls, str) else str(cls.__doc__ or "").strip().splitlines()[0]


def _cell(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|")


if __name__ == "__main__":
    PAGE.write_text(page(), "utf-8")
    print(f"{PAGE}: written")
