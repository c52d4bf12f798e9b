"""`hodge new-plugin`: a package with a stage of one's own that works as it is."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from jinja2 import Environment, FileSystemLoader, StrictUndefined

from hodge_pipeline.errors import RecipeError, WorkspaceError
from hodge_pipeline.store.artifacts import write_text

NAME = r"[a-z][a-z0-9]*(_[a-z0-9]+)*"


@dataclass(frozen=True)
class Example:
    """A kind of stage that there is a template for: what the stage does, and how it is used."""

    summary: str
    use: str


EXAMPLES = {
    "registration": Example(
        "Registers two clouds by Open3D's point-to-plane ICP.",
        "hodge run tum --source SEQUENCE --set registration={name} --out runs/mine",
    ),
    "readers": Example(
        "Reads a folder of .npz files: points (N, 3) in metres, and world_from_cam (4, 4) where it is known.",
        "hodge run clouds --source FOLDER --set source.reader={name} --out runs/mine",
    ),
}


def new_plugin(name: str, kind: str, folder: Path) -> None:
    """Write the package and print what to type next."""
    written = write_plugin(name, kind, folder)
    print("\n".join(f"{'written':<9}{path}" for path in written))
    print(f"{'next':<9}cd {folder} && pip install -e . && pytest")


def write_plugin(name: str, kind: str, folder: Path) -> list[Path]:
    """The files of a new package, written into a folder that is not there yet.

    Raises `RecipeError` for a name that is none or a kind without a template, `WorkspaceError` where the folder exists.
    """
    if not re.fullmatch(NAME, name):
        raise RecipeError(f"new-plugin: '{name}' is no name of a stage: use a-z, 0-9 and _, such as my_icp")
    if kind not in EXAMPLES:
        raise RecipeError(f"new-plugin: no template of kind '{kind}' (known: {', '.join(EXAMPLES)})")
    if folder.exists():
        raise WorkspaceError(f"{folder}: is there already: choose another folder with --out")
    folder.mkdir(parents=True)
    paths = []
    for file, text in plugin_files(name, kind):
        write_text(folder / file, text)
        paths.append(folder / file)
    return paths


def plugin_files(name: str, kind: str) -> Iterator[tuple[str, str]]:
    """The files of a package, (name, contents) each."""
    templates = Environment(
        loader=FileSystemLoader(Path(__file__).parent / "plugin_template"),
        undefined=StrictUndefined, keep_trailing_newline=True,
    )  # fmt: skip
    module = f"hodge_{name}"
    words = {
        "name": name,
        "kind": kind,
        "module": module,
        "package": module.replace("_", "-"),
        "cls": "".join(part.capitalize() for part in name.split("_")),
        "summary": EXAMPLES[kind].summary,
        "use": EXAMPLES[kind].use.format(name=name),
    }
    for template, file in (
        ("pyproject.toml.j2", "pyproject.toml"),
        (f"{kind}.py.j2", f"{module}.py"),
        (f"test_{kind}.py.j2", f"test_{name}.py"),
        ("README.md.j2", "README.md"),
    ):
        yield file, templates.get_template(template).render(words)
