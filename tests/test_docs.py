"""The documentation: its commands parse, its examples run, its reference is the code's, its links lead somewhere."""

from __future__ import annotations

import re
import runpy
import shlex
import shutil
from dataclasses import fields
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
import typer.main

import hodge_pipeline
from hodge_pipeline.cli.main import app
from hodge_pipeline.recipe.schema import load_recipe
from hodge_pipeline.types import PointCloud, Registration
from plugin_metadata import installed, write_metadata
from synthetic import LIGHT, short_sequence  # noqa: F401 - a fixture

REPOSITORY = Path(__file__).resolve().parents[1]
DOCS = REPOSITORY / "docs"
PAGES = [REPOSITORY / "README.md", *sorted(DOCS.glob("*.md"))]
EXAMPLE = DOCS / "examples" / "far_loops"
SMALL = (*LIGHT, "fusion=[{stage: cloud}]", "recording.level=summary")


def blocks(page: Path, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", page.read_text("utf-8"), flags=re.M | re.S)


def commands(page: Path) -> list[list[str]]:
    """The words of every `hodge` line, without its comment."""
    lines = [line for block in blocks(page, "sh") for line in block.replace("\\\n", " ").splitlines()]
    return [shlex.split(line, comments=True)[1:] for line in lines if line.startswith("hodge ")]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_command_parses(page: Path) -> None:
    root = typer.main.get_command(app)
    for words in commands(page):
        group, rest = root, words
        while hasattr(group, "commands"):
            assert rest and rest[0] in group.commands, f"{page.name}: hodge {shlex.join(words)}"
            group, rest = group.commands[rest[0]], rest[1:]
        group.make_context("hodge", [word for word in rest if word != ">"][: None if ">" not in rest else -1])


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_option_of_a_run_is_one_of_its_recipe(page: Path) -> None:
    for command, recipe, *rest in [words for words in commands(page) if len(words) > 1]:
        sets = [change for flag, change in pairwise(rest) if flag == "--set"]
        if command == "run" and not recipe.endswith(".yaml"):
            load_recipe(recipe, sets)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_link_leads_somewhere(page: Path) -> None:
    for target in re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", page.read_text("utf-8")):
        assert (page.parent / target).exists(), f"{page.name}: {target}"


def test_the_reference_of_recipes_is_up_to_date() -> None:
    written = runpy.run_path(str(REPOSITORY / "tools" / "recipe_reference.py"))["page"]()
    assert (DOCS / "recipes.md").read_text("utf-8") == written, "run: python tools/recipe_reference.py"


def test_the_index_names_every_page() -> None:
    index = (DOCS / "README.md").read_text("utf-8")
    assert [page.name for page in DOCS.glob("*.md") if page.name != "README.md" and page.name not in index] == []


@pytest.fixture(scope="module")
def workplace(tmp_path_factory: pytest.TempPathFactory, short_sequence: Path) -> Path:  # noqa: F811
    """A folder with a small run in place of the demo's, and a sequence under the name that the pages use."""
    folder = tmp_path_factory.mktemp("docs")
    (folder / "SEQUENCE").symlink_to(short_sequence, target_is_directory=True)
    (folder / "docs").symlink_to(DOCS, target_is_directory=True)
    hodge_pipeline.run(load_recipe("demo", SMALL, short_sequence), folder / "runs" / "demo")
    return folder


def test_the_quick_start_runs(workplace: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its long commands get small options; its pages in a viewer are left to the viewer's own tests."""
    monkeypatch.chdir(workplace)
    ran = 0
    for words in commands(DOCS / "quick-start.md"):
        if words[0] in ("demo", "view"):
            continue
        if words[0] == "run":
            sets = [
                word
                for change in SMALL
                if not any(change.split("=")[0] in w for w in words)
                for word in ("--set", change)
            ]
            words = [*words, *sets]
        app(words, standalone_mode=False)
        ran += 1
    assert ran >= 6
    assert (workplace / "runs/faster/compare.html").is_file()


def test_python_of_the_quick_start(workplace: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As it stands, but for the recipe, which becomes that of the run that is there already."""
    monkeypatch.chdir(workplace)
    (code,) = blocks(DOCS / "quick-start.md", "python")
    given = f"load_recipe('demo', {SMALL!r}), 'runs/demo', source={str(short(workplace))!r}"
    shown = 'hodge_pipeline.run("tum", "runs/mine", source="SEQUENCE")'
    assert shown in code
    exec(code.replace(shown, f"hodge_pipeline.run({given})"), {"load_recipe": load_recipe})


def test_arrays_in_hand(capsys: pytest.CaptureFixture[str]) -> None:
    code = next(block for block in blocks(DOCS.parent / "README.md", "python") if "from_edges" in block)
    names: dict[str, Any] = {}
    exec(code, names)
    solution = names["solution"]
    assert solution.certified is True
    assert 0 < solution.metrics["objective"] < 25 * 0.1**2
    assert "globally optimal" in capsys.readouterr().out


def short(workplace: Path) -> Path:
    return (workplace / "SEQUENCE").resolve()


@pytest.mark.parametrize(("name", "language"), [("far_loops.py", "python"), ("far_loops.yaml", "yaml")])
def test_the_page_shows_the_example_as_it_is(name: str, language: str) -> None:
    assert (EXAMPLE / name).read_text("utf-8") in blocks(DOCS / "writing-a-plugin.md", language)


@pytest.mark.parametrize("kind", [PointCloud, Registration])
def test_the_page_for_plugins_tells_every_field_of_what_comes_in_and_goes_out(kind: type) -> None:
    listed = re.findall(r"^\| `(\w+)` \|", (DOCS / "writing-a-plugin.md").read_text("utf-8"), flags=re.M)
    assert {field.name for field in fields(kind)} <= set(listed)


def test_the_example_package_is_installed_and_runs(workplace: Path, tmp_path: Path) -> None:
    site = tmp_path / "site"
    site.mkdir()
    shutil.copy(EXAMPLE / "far_loops.py", site)
    write_metadata(EXAMPLE, site)
    near = "edges.builders=[{stage: sequential}, {stage: far_loops, gap: 5, max_distance_m: 0.5}]"
    with installed(site):
        recipe = load_recipe(str(EXAMPLE / "far_loops.yaml"), [*SMALL, "recording.level=off", near])
        hodge_pipeline.run(recipe, tmp_path / "run", source=workplace / "SEQUENCE")
    edges = (tmp_path / "run/edges.csv").read_text()
    assert "far loop" in edges and "sequential" in edges
