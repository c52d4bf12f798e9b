"""Every file of every step truncated, zeroed, flipped, emptied or taken away: it is healed, or refused in one line."""

from __future__ import annotations

import os
import random
import shutil
from pathlib import Path

from small_run import Outcome, made, recipe

import hodge_pipeline
from hodge_pipeline.errors import HodgeError
from hodge_pipeline.run_folder import Run

WAYS = ("truncated", "zeroed", "flipped", "emptied", "gone", "pipe")
SEEDED = 40


def cases(full: bool, scratch: Path, seed: int) -> list[str]:
    """Each file of the steps in each way, or a seeded part."""
    run = made(scratch).run
    files = sorted(str(path.relative_to(run)) for path in (run / "stages").rglob("*") if path.is_file())
    every = [f"{way}/{file}" for file in files for way in WAYS]
    return every if full else sorted(random.Random(seed).sample(every, SEEDED))


def spoil(path: Path, way: str, seed: str) -> None:
    """Damage a file in one way."""
    contents, rng = bytearray(path.read_bytes()), random.Random(seed)
    at = rng.randrange(len(contents) or 1)
    path.unlink()
    if way == "gone":
        return
    if way == "pipe":
        os.mkfifo(path)
        return
    if way == "flipped" and contents:
        contents[at] ^= 1 << rng.randrange(8)
    if way == "zeroed":
        contents[at // 2 : at // 2 + 64] = bytes(len(contents[at // 2 : at // 2 + 64]))
    path.write_bytes({"truncated": contents[:at], "emptied": b""}.get(way, contents))


def check(name: str, scratch: Path) -> dict[str, int]:
    """One file in one way: what reads the folder refuses it or reads the same; the same command heals it or says it."""
    way, file = name.split("/", 1)
    things, folder = made(scratch), scratch / "damaged"
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(things.run, folder)
    spoil(folder / file, way, name)
    wanted, told = Outcome.of(things.run), 0
    try:
        assert Run.load(folder).poses.tobytes() == wanted.poses, "other poses, silently"
    except HodgeError as error:
        assert "\n" not in str(error)
        told = 1
    try:
        hodge_pipeline.run(recipe(things.source), folder)
    except HodgeError as error:
        assert way == "pipe" and "\n" not in str(error), error
        return {"refused in one line": 1}
    differences = wanted.differences(Outcome.of(folder))
    assert not differences, differences
    return {"refused by readers, healed by the run" if told else "healed": 1}
