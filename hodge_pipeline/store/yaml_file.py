"""YAML as data: plain values and where each came from. No tag constructs anything, sizes are bounded."""

from __future__ import annotations

import math
from collections.abc import Iterator
from copy import deepcopy
from dataclasses import dataclass
from functools import lru_cache
from io import StringIO
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.comments import CommentedMap, CommentedSeq, TaggedScalar
from ruamel.yaml.composer import MaxDepthExceededError
from ruamel.yaml.error import MarkedYAMLError, YAMLError

from hodge_pipeline.errors import RecipeError
from hodge_pipeline.se3 import MAX_NUMBER
from hodge_pipeline.types.input_files import read_input_text

MAX_BYTES = 100_000
"""A recipe with every default written out has about 3 kB; what is this long takes up to 2 s to parse."""
MAX_NODES = 20_000
MAX_DEPTH = 50
"""Levels: a recipe has five."""
MAX_INT = 1 << 63
"""Larger than any option; Python refuses to print integers of more than 4300 digits."""

Keys = tuple[str | int, ...]


@dataclass(frozen=True)
class Document:
    """Plain data, and the origin (`file:line` or the override) of each key, by its path from the root."""

    data: dict[str, Any]
    origins: dict[Keys, str]

    def where(self, keys: Keys) -> str:
        """The origin of a key, or of the nearest key above it that was written."""
        while keys and keys not in self.origins:
            keys = keys[:-1]
        return self.origins[keys]


def read(path: Path) -> Document:
    """The mapping in a YAML file. Raises `RecipeError` with file and line."""
    try:
        text = read_input_text(path, MAX_BYTES)
    except OSError as error:
        raise RecipeError(f"{path}: no recipe that can be read ({error.strerror}): give another file") from error
    except UnicodeDecodeError as error:
        raise RecipeError(f"{path}: no text in UTF-8 at byte {error.start}: save it as UTF-8") from error
    return parse(text, str(path))


def parse(text: str, name: str) -> Document:
    """The mapping in a YAML text; `name` stands for the file in origins and errors."""
    document = _parsed(text, name)
    return Document(deepcopy(document.data), dict(document.origins))


@lru_cache(maxsize=16)  # every use of a run reads its recipe, which takes 40 ms
def _parsed(text: str, name: str) -> Document:
    try:
        yaml = YAML(typ="rt", pure=True)
        yaml.max_depth = MAX_DEPTH + 1  # a value lies one level below what it is in
        root = yaml.load(text)
    except MaxDepthExceededError as error:
        line = error.problem_mark.line + 1
        raise RecipeError(f"{name}:{line}: more than {MAX_DEPTH} levels: this is no recipe") from error
    except MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        line = mark.line + 1 if mark else 1
        problem = str(error.problem).splitlines()[0]
        if problem.startswith("but "):  # ruamel's problem is then the second half of a sentence
            problem = f"{error.context}, {problem}"
        remedy = ": indent with blanks" if r"'\t'" in problem else ""
        raise RecipeError(f"{name}:{line}: {problem}{remedy}") from error
    except AttributeError as error:  # of ruamel, at `&a {<<: *a}`
        raise RecipeError(f"{name}: not YAML: a mapping is merged into itself") from error
    except (YAMLError, ValueError, RecursionError) as error:
        raise RecipeError(f"{name}: not YAML: {str(error).splitlines()[0]}") from error
    if root is None:
        root = CommentedMap()
    if not isinstance(root, CommentedMap):
        raise RecipeError(f"{name}:1: a recipe is a mapping of keys to values, found another kind of value")
    origins: dict[Keys, str] = {(): f"{name}:1"}
    budget = iter(range(MAX_NODES))
    data = _plain(root, (), 1, name, origins, budget)
    return Document(data, origins)


def parse_value(text: str, name: str) -> Document:
    """The value of an override such as `--set a.b=[1, 2]`, under the key `value`."""
    return parse(f"value: {text}", name)


def dump(data: dict[str, Any]) -> str:
    """The YAML text of plain data, block style, keys in their order."""
    out = StringIO()
    yaml = YAML(typ="safe", pure=True)
    yaml.default_flow_style = False
    yaml.sort_base_mapping_type_on_output = False  # type: ignore[assignment]
    yaml.width = 120
    yaml.dump(data, out)
    return out.getvalue()


def _plain(node: Any, path: Keys, line: int, name: str, origins: dict[Keys, str], budget: Iterator[int]) -> Any:
    """A node as dict, list or scalar; refuses tags, and more nodes than any recipe has (aliases multiply)."""
    if next(budget, None) is None or len(path) > MAX_DEPTH:  # an alias of what it lies in never ends
        raise RecipeError(f"{name}:{line}: more than {MAX_NODES} values, or {MAX_DEPTH} levels: this is no recipe")
    origins[path] = f"{name}:{line}"
    tag = getattr(getattr(node, "tag", None), "value", None)
    if isinstance(node, TaggedScalar) or tag is not None:
        raise RecipeError(f"{name}:{line}: the tag '{tag}' is not allowed: a recipe is data and constructs nothing")
    if isinstance(node, CommentedMap):
        return {
            _key(key, name, line): _plain(value, (*path, str(key)), _line(node, key, line), name, origins, budget)
            for key, value in node.items()
        }
    if isinstance(node, CommentedSeq):
        return [
            _plain(value, (*path, row), node.lc.item(row)[0] + 1, name, origins, budget)
            for row, value in enumerate(node)
        ]
    return _scalar(node, name, line)


def _line(node: CommentedMap, key: Any, line: int) -> int:
    """The line of a key; of one that `<<` merges into the mapping, that of the mapping."""
    return int(node.lc.data[key][0]) + 1 if key in (node.lc.data or {}) else line


def _key(key: Any, name: str, line: int) -> str:
    if not isinstance(key, str):
        raise RecipeError(f"{name}:{line}: the key {key!r} is not a name")
    return str(key)


def _scalar(node: Any, name: str, line: int) -> Any:
    if isinstance(node, str) and ("\0" in node or not node.isascii() and any("\ud800" <= c <= "\udfff" for c in node)):
        raise RecipeError(f"{name}:{line}: {node!r} holds a character that no file can have")
    if isinstance(node, int) and not -MAX_INT <= node < MAX_INT:
        raise RecipeError(f"{name}:{line}: a whole number of {node.bit_length()} bits has no use in a recipe")
    if isinstance(node, float) and MAX_NUMBER <= abs(node) < math.inf:
        raise RecipeError(f"{name}:{line}: a number past {MAX_NUMBER:g} has no use in a recipe")
    for kind in (bool, int, float, str):
        if isinstance(node, kind):
            return kind(node)
    if node is None:
        return None
    raise RecipeError(f"{name}:{line}: a value of type {type(node).__name__} has no use in a recipe")
