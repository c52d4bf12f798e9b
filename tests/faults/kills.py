"""kill -9 of the whole group, of the parent and of a worker of a command, at a seeded time; and a full disk."""

from __future__ import annotations

import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil
from small_run import Outcome, made, recipe

import hodge_pipeline
from hodge_pipeline.errors import WorkspaceError

VICTIMS = ("group", "parent", "worker")
FILE_SIZES = (0, 1, 100, 500, 1000, 3000, 10_000, 20_000, 50_000, 200_000)
"""Bytes that a file may have at most: each write past it fails, as on a full disk."""
DISK_KB = (4, 16, 64, 128, 256, 512, 768, 1024)
COMMAND = (
    "import sys; sys.path[:0] = sys.argv[1:3]; from pathlib import Path; import hodge_pipeline; import small_run; "
    "hodge_pipeline.run(small_run.recipe(Path(sys.argv[3]), *sys.argv[5:]), sys.argv[4])"
)


def cases(full: bool, scratch: Path, seed: int) -> list[str]:
    """Kills at seeded times, and each size of file and disk."""
    kills = [f"{victim}/{seed}/{row}" for row in range(10 if full else 2) for victim in VICTIMS]
    return [*kills, *(f"file/{size}" for size in FILE_SIZES), *(f"disk/{size}" for size in DISK_KB)]


def check(name: str, scratch: Path) -> dict[str, int]:
    """One kill or one full disk; the same command then goes on to the same bits."""
    kind, *rest = name.split("/")
    if kind == "file":
        return _small_files(int(rest[0]), scratch)
    if kind == "disk":
        return _small_disk(int(rest[0]), scratch)
    things, folder, rng = made(scratch), scratch / "killed", random.Random(name)
    shutil.rmtree(folder, ignore_errors=True)
    more = ["executor.workers=1"] if kind == "worker" else []
    paths = [os.path.dirname(__file__), str(Path(__file__).parents[1]), str(things.source), str(folder), *more]
    process = subprocess.Popen([sys.executable, "-W", "ignore", "-c", COMMAND, *paths], start_new_session=True)
    _wait_for(folder / ".lock", process)
    time.sleep(rng.random() * 2)
    outcome = _kill(process, kind)
    _finish(things.source, folder, more)
    differences = _without_recipe(Outcome.of(things.run), Outcome.of(folder), bool(more))
    assert not differences, differences
    return {outcome: 1}


def _kill(process: subprocess.Popen[bytes], victim: str) -> str:
    if victim == "worker":
        with_workers = psutil.Process(process.pid).children(recursive=True) if process.poll() is None else []
        for worker in with_workers[-1:]:
            worker.kill()
        process.wait(timeout=120)
        return "a lost worker was replaced" if with_workers else "ended before it was killed"
    if process.poll() is None:
        os.kill(process.pid, signal.SIGKILL) if victim == "parent" else os.killpg(process.pid, signal.SIGKILL)
    process.wait(timeout=60)
    return "resumed to the same bits" if process.returncode else "ended before it was killed"


def _wait_for(path: Path, process: subprocess.Popen[bytes]) -> None:
    while not path.exists() and process.poll() is None:
        time.sleep(0.02)


def _finish(source: Path, folder: Path, more: list[str]) -> None:
    """Run to the end, once those of the killed process that are left have let go of the folder."""
    for _ in range(200):
        try:
            hodge_pipeline.run(recipe(source, *more), folder)
            return
        except WorkspaceError as error:
            if "another run uses" not in str(error):
                raise
            time.sleep(0.1)
    raise AssertionError("the folder stays locked")


def _without_recipe(wanted: Outcome, found: Outcome, other_recipe: bool) -> list[str]:
    return [one for one in wanted.differences(found) if not other_recipe or "recipe" not in one]


def _small_files(size: int, scratch: Path) -> dict[str, int]:
    things, folder = made(scratch), scratch / "small"
    shutil.rmtree(folder, ignore_errors=True)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        outcome = _refused(things.source, folder)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    _finish(things.source, folder, [])
    differences = Outcome.of(things.run).differences(Outcome.of(folder))
    assert not differences, differences
    return {outcome: 1}


def _small_disk(size_kb: int, scratch: Path) -> dict[str, int]:
    things, disk = made(scratch), scratch / f"disk-{size_kb}"
    disk.mkdir(exist_ok=True)
    mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size_kb}k", "none", str(disk)], capture_output=True)
    if mounted.returncode:
        return {f"left out: {mounted.stderr.decode().strip().splitlines()[-1]}": 1}
    try:
        outcome = _refused(things.source, disk / "run")
        subprocess.run(["mount", "-o", "remount,size=64m", str(disk)], check=True)
        _finish(things.source, disk / "run", [])
        differences = Outcome.of(things.run).differences(Outcome.of(disk / "run"))
        assert not differences, differences
    finally:
        subprocess.run(["umount", "-l", str(disk)], check=True)
    return {outcome: 1}


def _refused(source: Path, folder: Path) -> str:
    try:
        hodge_pipeline.run(recipe(source), folder)
    except WorkspaceError as error:
        assert "\n" not in str(error)
        return "told in one line, resumed to the same bits"
    return "had room"
