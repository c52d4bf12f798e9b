"""A stranger's run folder and names: nothing outside is touched, nothing waits, nothing escapes into a page."""

from __future__ import annotations

import csv
import os
import shlex
import shutil
from collections.abc import Callable
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

from small_run import made, recipe

import hodge_pipeline
from hodge_adapters.tum.reader import TumReader
from hodge_pipeline.errors import HodgeError
from hodge_pipeline.recipe.schema import load_recipe
from hodge_pipeline.store.workspace import Workspace, holding
from hodge_pipeline.uses.recipe_run import solve_again

NAMES = (
    "<script>alert(1)</script>", "\"><img src=x onerror=alert(1)>", "=HYPERLINK(\"http://x\")", "\x1b[31mred", "a\nb",
    "../../outside", "a/b", "-rf", "{count}", "[bold]x[/]", "x" * 200, "'", "\u202eevil", "@SUM(A1)", "café", "a b",
    "=SUM(A1)\n<script>alert(1)</script>",
)  # fmt: skip
OUTSIDE = "what is outside"


def _link(place: str) -> Callable[[Path, Path], None]:
    def change(folder: Path, outside: Path) -> None:
        path = folder / place
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink(missing_ok=True)
        path.symlink_to(outside / ("folder" if "." not in Path(place).name else "file.txt"))

    return change


def _pipe(place: str) -> Callable[[Path, Path], None]:
    def change(folder: Path, _: Path) -> None:
        (folder / place).unlink(missing_ok=True)
        os.mkfifo(folder / place)

    return change


def _text(place: str, text: str) -> Callable[[Path, Path], None]:
    def change(folder: Path, _: Path) -> None:
        (folder / place).write_text(text)

    return change


PLACES = ("log.txt", "stages", "recipe.yaml", "edges.csv", "report.html", "stages/index.json", "stages/end-1", ".lock")
FOLDERS: dict[str, Callable[[Path, Path], None]] = {
    **{f"link at {place}": _link(place) for place in PLACES},
    **{f"pipe at {place}": _pipe(place) for place in PLACES if "." in Path(place).name},
    "tag in recipe.yaml": _text("recipe.yaml", "a: !!python/object/apply:os.system [touch outside]"),
    "deep recipe.yaml": _text("recipe.yaml", "a: " + "[" * 9000),
    "cluster in recipe.yaml": _text("recipe.yaml", "executor: {stage: dask, address: 'tcp://127.0.0.1:1'}"),
    "no json in edits.json": _text("edits.json", "[" * 90_000),
    "other edits.json": _text("edits.json", '{"edits": [{"disable": ["\\u001b[31m0-1"]}]}'),
    "index that leaves": _text("stages/index.json", '{"steps": [{"name": "../../outside", "function": "end"}]}'),
    "edges.csv of another": _text("edges.csv", "i,j,source,status\n=1+1,\x1b[31m,x,y\n"),
}


def cases(full: bool, scratch: Path, seed: int) -> list[str]:
    """Every hostile folder, by each command, and every name."""
    commands = ("run", "solve", "hold", "load")
    folders = [f"{command}/{name}" for name in FOLDERS for command in commands]
    names = [f"{kind}/{row}" for kind in ("name", "command") for row in range(len(NAMES))]
    return [*folders, *names]


def check(name: str, scratch: Path) -> dict[str, int]:
    """One folder by one command, or one name through a whole run."""
    kind, what = name.split("/", 1)
    if kind == "command":
        return _typed(NAMES[int(what)], scratch)
    if kind == "name":
        return _named(NAMES[int(what)], scratch)
    things, folder, outside = made(scratch), scratch / "theirs", scratch / "outside"
    for path in (folder, outside):
        shutil.rmtree(path, ignore_errors=True)
    (outside / "folder").mkdir(parents=True)
    (outside / "file.txt").write_text(OUTSIDE)
    shutil.copytree(things.run, folder)
    FOLDERS[what](folder, outside)
    try:
        _command(kind, things.source, folder)
    except HodgeError as error:
        assert "\n" not in str(error), error
        outcome = "refused in one line"
    else:
        outcome = "healed or unharmed"
    assert (outside / "file.txt").read_text() == OUTSIDE
    assert sorted(path.name for path in outside.rglob("*")) == ["file.txt", "folder"]
    return {outcome: 1}


def _command(kind: str, source: Path, folder: Path) -> None:
    if kind == "run":
        hodge_pipeline.run(recipe(source), folder)
    elif kind == "solve":
        solve_again(folder)
    elif kind == "load":
        hodge_pipeline.Run.load(folder)
        load_recipe(str(folder / "recipe.yaml"))
    else:
        with holding(folder):
            pass


def _typed(name: str, scratch: Path) -> dict[str, int]:
    """The command that a refusal prints, of a folder of this name, typed into a shell."""
    theirs = scratch / f"touch {name.replace('/', '_')}; touch outside"
    shutil.rmtree(theirs, ignore_errors=True)
    (theirs / "stages" / "begun.part").mkdir(parents=True)
    (theirs / "recipe.yaml").write_text("pace: 1")
    try:
        Workspace.reopen(theirs, {"pace": 2})
    except HodgeError as error:
        printed = str(error).split("): '", 1)[1].rsplit("' brings it up", 1)[0]
    assert shlex.split(printed) == ["hodge", "run", str(theirs / "recipe.yaml"), "--out", str(theirs), "--overwrite"]
    return {"quoted": 1}


class _Tags(HTMLParser):
    """The tags and event handlers of a page."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        """Keep a tag that runs code, or an attribute that does."""
        self.found += [tag] if tag in ("script", "iframe", "object") else []
        self.found += [name for name, _ in attributes if name.startswith("on")]


def _named(name: str, scratch: Path) -> dict[str, int]:
    things, folder = made(scratch), scratch / "named"
    shutil.rmtree(folder, ignore_errors=True)
    opened = TumReader().open(things.source)
    frames = [
        replace(frame, frame_id=f"{name}{row}", sequence=name if row < 3 else f"{name}+")
        for row, frame in enumerate(opened.frames)
    ]
    source = replace(opened, frames=frames, name=name, notes=(f"of {name}",), trajectory=None)
    hodge_pipeline.run(recipe(things.source), folder, source=source)
    page = _Tags()
    page.feed((folder / "report.html").read_text("utf-8"))
    assert not page.found, page.found
    with (folder / "edges.csv").open(newline="", encoding="utf-8") as file:
        for row in csv.reader(file):
            assert all(cell[:1] not in ("=", "+", "-", "@", "\t", "\r") for cell in row[:2]), row
    log = (folder / "log.txt").read_text("utf-8")
    assert all(c.isprintable() or c == "\n" for c in log)
    assert all(line[:4].isdigit() for line in log.splitlines()), "a line of the log that no logger wrote"
    assert {path.parent for path in folder.glob("poses*.tum")} == {folder}
    assert len(list(folder.glob("poses-*.tum"))) == 2
    return {"shown without effect": 1}
