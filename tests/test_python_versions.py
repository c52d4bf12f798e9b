"""Which Pythons the package claims: the same everywhere, and none that its own dependencies refuse."""

import re
import tomllib
from importlib.metadata import metadata
from pathlib import Path

from packaging.specifiers import SpecifierSet

REPOSITORY = Path(__file__).resolve().parents[1]
PYPROJECT = tomllib.loads((REPOSITORY / "pyproject.toml").read_text("utf-8"))
LEAST = PYPROJECT["project"]["requires-python"].removeprefix(">=")


def test_no_dependency_refuses_the_oldest_python() -> None:
    names = [re.split(r"[\s<>=\[]", each)[0] for each in PYPROJECT["project"]["dependencies"]]
    refusing = [name for name in names if f"{LEAST}.0" not in SpecifierSet(metadata(name)["Requires-Python"] or "")]
    assert refusing == []


def test_the_oldest_python_is_the_same_everywhere() -> None:
    classifiers = [each.rsplit(" ")[-1] for each in PYPROJECT["project"]["classifiers"] if ":: Python :: 3." in each]
    assert min(classifiers, key=lambda version: int(version.split(".")[1])) == LEAST
    tools = PYPROJECT["tool"]
    assert tools["ruff"]["target-version"] == f"py{LEAST.replace('.', '')}"
    assert tools["mypy"]["python_version"] == LEAST
    for page in ("README.md", "docs/quick-start.md"):
        assert f"Python {LEAST} or newer" in (REPOSITORY / page).read_text("utf-8")
