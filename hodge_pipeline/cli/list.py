"""The commands that only look: inspect, stages, recipes."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from hodge_pipeline import registry
from hodge_pipeline.cli.guard import shown
from hodge_pipeline.errors import HodgeError, RecipeError
from hodge_pipeline.types.text import command


def inspect(path: Path, *, reader: str | None, settings: Sequence[str], as_json: bool) -> None:
    """Print what a path is, opened by the surest reader or the one that is named."""
    from hodge_pipeline.cli.reader_choice import choose_reader
    from hodge_pipeline.sources.inspect import inspect as facts_of

    facts = facts_of(path, choose_reader(path, reader, settings) if reader or settings else None)
    if as_json:
        from hodge_pipeline.cli.console import print_json

        print_json(facts)
        return
    following = next_command(path, facts, reader, settings)
    for name, value in (*facts.items(), *([("next", following)] if following else ())):
        for row, text in enumerate(_rows(value)):
            print(f"{name if row == 0 else '':<33} {text}")


def next_command(path: Path, facts: dict[str, Any], reader: str | None, settings: Sequence[str] = ()) -> str:
    """The command to type next for a path with these `facts`, opened by this reader with these `settings`; "" where no
    command makes anything of it: images alone, without a pose.
    """
    if not facts["frames"]:
        if facts.get("graph", {}).get("edges"):
            return command("hodge", "solve", path, "--out", "solved.g2o")
        return command("hodge", "refine", "trajectory", path, "--frames", "DIR", "--out", f"runs/{path.stem}")
    from hodge_pipeline.cli.reader_choice import IN_A_RECIPE
    from hodge_pipeline.recipe.recipe_file import recipe_names
    from hodge_pipeline.sources.opening import RECIPES

    given = (*settings, *facts.get("missing", ()))
    options = [word for setting in given for word in ("--set", IN_A_RECIPE + setting.removeprefix(IN_A_RECIPE))]
    name = reader or next((guess["reader"] for guess in facts["formats"]), "")
    if name == "colmap" and not facts["frames with depth"]:  # images alone are nothing to register
        return command("hodge", "refine", "colmap", path, "--out", f"runs/{path.stem}")
    if not facts["frames with depth"] and not facts["frames with points"]:
        return command("hodge", "convert", path, "poses.tum") if facts["frames with a pose"] else ""
    recipe = "lidar" if facts.get("scanner") and not reader else RECIPES.get(name, name)
    if recipe == "mcap" and facts.get("frames with points") == facts["frames"]:
        recipe = "mcap_clouds"
    brings_poses = path.suffix.lower() == ".e57" or (recipe == "scans" and any(path.glob("*.pose")))
    if brings_poses and facts["frames with a pose"] == facts["frames"]:
        options += ["--set", "start=given"]  # the surveyor's poses, which keep the scans in his world, or 3DTK's
    if recipe in recipe_names():
        return command("hodge", "run", recipe, "--source", path, *options, "--out", f"runs/{path.stem}")
    recipe = "seven_scenes" if facts["frames with depth"] else "clouds"
    named = ("--set", f"source.reader={name}", *options, "--out", f"runs/{path.stem}")
    return command("hodge", "run", recipe, "--source", path, *named)


def _rows(value: Any) -> list[str]:
    """The lines of a fact: one for each of several words, numbers side by side."""
    if isinstance(value, dict):
        return [f"{key}: {_words(item)}" for key, item in value.items()]
    if isinstance(value, list) and any(isinstance(item, (str, dict)) for item in value):
        return [_words(item) for item in value]
    return [_words(value)] if value != [] else []


def _words(value: Any) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{key} {_words(item)}" for key, item in value.items())
    if isinstance(value, list):
        return "  ".join(_words(item) for item in value)
    return f"{value:.6g}" if isinstance(value, float) and abs(value) < 1e6 else shown(str(value))


def stages(kind: str | None) -> None:
    """Print the stages, of one kind with all options; a broken plugin is named as such."""
    if kind is not None and kind not in registry.KINDS:
        raise RecipeError(f"no kind of stage '{kind}'{registry.suggestion(kind, list(registry.KINDS))}")
    for known in registry.KINDS.values():
        if kind in (None, known.name):
            print(f"{known.name}: {known.summary}")
            for name in registry.names(known.name):
                _print_stage(known.name, name, with_options=kind is not None)


def _print_stage(kind: str, name: str, *, with_options: bool) -> None:
    try:
        cls = registry.load(kind, name)
    except HodgeError as error:
        print(f"  {name:<16} broken: {error}")
        return
    summary = (cls.__doc__ or "").strip().splitlines()[:1]
    print(f"  {name:<16} {summary[0] if summary else ''} [{registry.origin(kind, name)}]")
    if with_options and dataclasses.is_dataclass(cls):
        for option, field in getattr(cls, "__pydantic_fields__", {}).items():
            default = "must be given" if field.is_required() else f"= {field.get_default(call_default_factory=True)!r}"
            print(f"      {option} {default}: {field.description or ''}")


def recipes(name: str | None, *, schema: bool) -> None:
    """Print the recipes' names and first words, one recipe with its defaults, or the JSON schema of its kind."""
    from hodge_pipeline.recipe import binding, recipe_file
    from hodge_pipeline.store import yaml_file

    if schema:
        print(json.dumps(binding.json_schema(_kind(name)), indent=1))
    elif name is not None:
        print(yaml_file.dump(binding.unbind(_any_recipe(name))), end="")
    else:
        for known in recipe_file.recipe_names():
            print(f"{known:<24}{recipe_file.load(known).data.get('description', '')}")


def _kind(name: str | None) -> type:
    """The type that a recipe binds to: `ModelRefinement` where it refines a model, else `Recipe`, as without a name."""
    from hodge_pipeline.recipe import recipe_file
    from hodge_pipeline.recipe.schema import Recipe
    from hodge_pipeline.refine.model_options import ModelRefinement

    return ModelRefinement if name is not None and "model" in recipe_file.load(name).data else Recipe


def _any_recipe(name: str) -> Any:
    """The options of a recipe of either kind."""
    from hodge_pipeline.recipe.schema import Recipe, load_recipe
    from hodge_pipeline.refine.model_options import load_model_refinement

    return load_recipe(name) if _kind(name) is Recipe else load_model_refinement(name)
