"""The house stays in the shape that docs/architecture.md draws."""

import ast
import re
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parents[1]
PACKAGE = REPOSITORY / "hodge_pipeline"
MAP = (REPOSITORY / "docs" / "architecture.md").read_text("utf-8")
MOST_AT_THE_TOP, MOST_FILES_OF_A_FRAME = 12, 20


def imported(path: Path) -> set[str]:
    """The modules of the package that a file imports, `from` imports of names among them."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text("utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    return found


def test_few_modules_stand_at_the_top_and_each_has_several_users() -> None:
    top = [path.stem for path in PACKAGE.glob("*.py")]
    assert len(top) <= MOST_AT_THE_TOP
    imports = {path: imported(path) for path in [*PACKAGE.rglob("*.py"), *(REPOSITORY / "adapters").rglob("*.py")]}
    for name in set(top) - {"__init__", "pipeline"}:
        users = [path for path, modules in imports.items() if f"hodge_pipeline.{name}" in modules]
        assert len(users) > 1, f"{name} has {len(users)} users: give it a room"


def test_every_file_that_the_map_names_is_there() -> None:
    named = set(re.findall(r"`([a-z0-9_/]+\.py)`", MAP))
    assert len(named) > 40
    for name in named:
        places = (REPOSITORY / name, PACKAGE / name, *PACKAGE.glob(f"*/{name}"))
        assert any(path.is_file() for path in places), name


def test_the_map_names_every_room() -> None:
    for path in PACKAGE.iterdir():
        if (path / "__init__.py").is_file():
            assert re.search(rf"\b{path.name}\b", MAP), path.name


def test_a_frame_passes_few_files_from_reader_to_mesh() -> None:
    walk = MAP.split("## The walk of a frame")[1].split("## ")[0]
    assert 10 < len(re.findall(r"^\| \d+ \|", walk, re.MULTILINE)) <= MOST_FILES_OF_A_FRAME
