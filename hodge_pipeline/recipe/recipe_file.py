"""Recipe files: found by name or path, composed by `extends`, changed by overrides."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from hodge_pipeline import registry
from hodge_pipeline.errors import RecipeError
from hodge_pipeline.store import yaml_file
from hodge_pipeline.store.yaml_file import Document, Keys

MAX_EXTENDS = 8
"""Recipes in a chain of `extends`: a longer one is a cycle."""


def recipe_folder() -> Path:
    """The folder of this package's recipes: inside it when installed from a wheel, else in the checkout."""
    package = Path(__file__).parents[1]
    inside = package / "recipes"
    return inside if inside.is_dir() else package.parent / "recipes"


def recipe_names() -> list[str]:
    """The names of the recipes that come with the package, sorted."""
    return sorted(path.stem for path in recipe_folder().glob("*.yaml"))


def find(name_or_path: str, beside: Path | None = None) -> Path:
    """The file of a recipe: a path, first relative to `beside`, or the name of an installed one.

    Raises `RecipeError` where there is none.
    """
    path = Path(name_or_path)
    if path.suffix in (".yaml", ".yml"):
        found = [base for base in ((beside or Path()) / path, path) if base.is_file()]
        if not found:
            raise RecipeError(f"{path}: no such recipe file")
        return found[0]
    installed = recipe_folder() / f"{name_or_path}.yaml"
    if path.name != name_or_path and path.exists():
        raise RecipeError(f"{name_or_path}: is no recipe: give the name of one, and this with --source")
    if not installed.is_file() or path.name != name_or_path:
        raise RecipeError(f"no recipe '{name_or_path}'{registry.suggestion(name_or_path, recipe_names())}")
    return installed


def load(name_or_path: str, overrides: Sequence[str] = ()) -> Document:
    """The plain data of a recipe, over those that it extends, with overrides (`a.b=value`) on top.

    Raises `RecipeError` with the file and line, or the override, that is wrong.
    """
    document = _extended(find(name_or_path), depth=0)
    for override in overrides:
        document = _overridden(document, override)
    _refuse_cluster(document)
    return document


def _refuse_cluster(document: Document) -> None:
    """Raise `RecipeError` where a recipe, which anybody may write, names a cluster: a scheduler runs code here."""
    executor = document.data.get("executor")
    options = executor if isinstance(executor, dict) else {"stage": executor}
    named = "address" if "address" in options else "stage" if options.get("stage") == "dask" else None
    if named is not None:
        key = ("executor", named) if isinstance(executor, dict) else ("executor",)
        raise RecipeError(
            f"{document.where(key)}: {'.'.join(key)}: a recipe names no cluster, since who answers there runs code "
            "here: write `executor: local`, and give the cluster that you trust as --dask ADDRESS"
        )


def _extended(path: Path, depth: int) -> Document:
    """A recipe merged over the one that it extends."""
    document = yaml_file.read(path)
    parent = document.data.pop("extends", None)
    if parent is None:
        return document
    where = document.origins[("extends",)]
    if not isinstance(parent, str) or depth == MAX_EXTENDS:
        raise RecipeError(f"{where}: extends: expected the name of a recipe, in a chain of at most {MAX_EXTENDS}")
    try:
        found = find(parent, beside=path.parent)
    except RecipeError as error:
        raise RecipeError(f"{where}: extends: {error}") from error
    base = _extended(found, depth + 1)
    merged = _merged(base.data, document.data)
    inherited = {keys: line for keys, line in base.origins.items() if _exists(merged, keys)}
    return Document(merged, {**inherited, **document.origins})


def _exists(data: Any, keys: Keys) -> bool:
    """Whether the data have a value at this path of keys."""
    try:
        for key in keys:
            data = data[key]
    except (KeyError, IndexError, TypeError):
        return False
    return True


def _merged(base: Any, over: Any) -> Any:
    """`over` merged over `base`: mappings key by key, anything else replaced; another stage takes no options over."""
    over_stage = over.get("stage") if isinstance(over, dict) else None
    if isinstance(base, str) and over_stage is None and isinstance(over, dict):
        base = {"stage": base}
    if not isinstance(base, dict) or not isinstance(over, dict):
        return over
    if over_stage is not None and over_stage != base.get("stage", over_stage):
        return over
    return {**base, **{key: _merged(base[key], value) if key in base else value for key, value in over.items()}}


def _overridden(document: Document, override: str) -> Document:
    """The document with one override `a.b=value`; a number in the path is a row of a list."""
    name = f"--set {override}"
    path, equals, text = override.partition("=")
    keys = path.strip().split(".")
    if not equals or not all(keys):
        raise RecipeError(f"{name}: expected a.b=value")
    given = yaml_file.parse_value(text, name)
    value = given.data["value"]
    typed = tuple(int(key) if key.isdigit() else key for key in keys)
    change = _nested(document.data, keys, value, name)
    merges = isinstance(value, dict)
    kept = {key: line for key, line in document.origins.items() if merges or key[: len(typed)] != typed}
    new = {(*typed, *inside[1:]): name for inside in given.origins if inside}
    return Document(change, {**{typed[:end]: name for end in range(1, len(typed))}, **kept, **new})


def _nested(data: Any, keys: list[str], value: Any, name: str) -> Any:
    """A copy of the data with the value at the path of keys. Raises `RecipeError` where the path cannot be."""
    if not keys:
        return _merged(data, value) if isinstance(value, dict) else value
    head, rest = keys[0], keys[1:]
    if isinstance(data, list):
        if not head.isdigit() or int(head) >= len(data):
            raise RecipeError(f"{name}: '{head}' is not a row of a list of {len(data)}")
        row = int(head)
        return [*data[:row], _nested(data[row], rest, value, name), *data[row + 1 :]]
    if isinstance(data, str) and any(data in registry.names(kind) for kind in registry.KINDS):
        data = {"stage": data}
    if data is not None and not isinstance(data, dict):
        raise RecipeError(f"{name}: '{head}' lies in a value that has no options: {data!r}")
    old = data or {}
    if head == "stage" and not rest and old.get("stage") != value:
        return {"stage": value}
    return {**old, head: _nested(old.get(head), rest, value, name)}
