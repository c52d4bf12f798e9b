"""A crash before every write of a run and of an edit: the folder as it is then, resumed, ends as an undisturbed one."""

from __future__ import annotations

import os
import random
import shutil
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from small_run import Made, Outcome, edit, made, recipe

import hodge_pipeline
from hodge_pipeline.uses.recipe_run import solve_again

WRITES = frozenset(("os.rename", "os.remove", "os.rmdir", "os.mkdir", "os.link", "os.truncate", "shutil.rmtree"))
SEEDED = 60
EVERY = 1
"""A folder is kept before every so many writes."""
_before_write: list[Callable[[str], None]] = []


def _hook(event: str, arguments: tuple[object, ...]) -> None:
    if not _before_write or (event != "open" and event not in WRITES):
        return
    path = arguments[0]
    if event == "open" and not (isinstance(arguments[2], int) and arguments[2] & (os.O_WRONLY | os.O_RDWR)):
        return
    if isinstance(path, (str, bytes, os.PathLike)):
        _before_write[-1](os.fsdecode(path))


sys.addaudithook(_hook)


@contextmanager
def before_each_write(folder: Path, act: Callable[[int], None]) -> Iterator[None]:
    """Call `act` with the number of each write into the folder, before it is done."""
    count, inside = 0, str(folder)

    def seen(path: str) -> None:
        nonlocal count
        if path.startswith(inside):
            _before_write.pop()  # what `act` itself writes does not count
            act(count)
            count += 1
            _before_write.append(seen)

    _before_write.append(seen)
    try:
        yield
    finally:
        _before_write.clear()


def _begin(things: Made, command: str, folder: Path) -> Callable[[], object]:
    """The command on this folder, prepared up to its first write."""
    if command == "run":
        return lambda: hodge_pipeline.run(recipe(things.source), folder)
    shutil.copytree(things.run, folder)
    edit(folder)
    return lambda: solve_again(folder)


def _snapshots(command: str, scratch: Path) -> list[Path]:
    """The folder as it is before each write of the command, one folder for each write."""
    things, folder, out = made(scratch), scratch / "crashing", scratch / f"before-{command}"
    if not (out / "done").exists():
        shutil.rmtree(out, ignore_errors=True)
        shutil.rmtree(folder, ignore_errors=True)
        out.mkdir()
        go = _begin(things, command, folder)

        def snapshot(number: int) -> None:
            copy = out / f"{number:04d}"
            if number % EVERY == 0:
                shutil.copytree(folder, copy) if folder.exists() else copy.mkdir()

        with before_each_write(folder, snapshot):
            go()
        shutil.rmtree(folder)
        (out / "done").touch()
    return sorted(path for path in out.iterdir() if path.is_dir())


def cases(full: bool, scratch: Path, seed: int) -> list[str]:
    """Every write of a run and of an edit where `full`, else a seeded part."""
    found = [f"{command}/{path.name}" for command in ("run", "edit") for path in _snapshots(command, scratch)]
    return found if full else sorted(random.Random(seed).sample(found, min(SEEDED, len(found))))


def check(name: str, scratch: Path) -> dict[str, int]:
    """One point. Raises `AssertionError` where the resumed folder differs from the undisturbed one."""
    command, at = name.split("/")
    things, folder = made(scratch), scratch / "crashing"
    before = next(path for path in _snapshots(command, scratch) if path.name == at)
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(before, folder)
    if command == "run":
        hodge_pipeline.run(recipe(things.source), folder)
    else:
        solve_again(folder)
    wanted = Outcome.of(things.run if command == "run" else things.edited)
    differences = wanted.differences(Outcome.of(folder))
    assert not differences, differences
    return {"resumed to the same bits": 1}
